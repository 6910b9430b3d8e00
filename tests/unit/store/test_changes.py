import sqlite3
from collections.abc import Iterator

import msgspec
import pytest

from appliance.store.changes import ROWS, Change, ChangeError, Delete, Put, Tables, join

SCHEMA = """
CREATE TABLE thing (
    name TEXT PRIMARY KEY, size INTEGER NOT NULL, weight REAL NOT NULL, picture BLOB, note TEXT
) WITHOUT ROWID;
CREATE TABLE other (number INTEGER PRIMARY KEY, text TEXT NOT NULL);
"""
ROW = ("a", 1, 1.5, b"x", None)


@pytest.fixture
def connection() -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(":memory:")
    connection.executescript(SCHEMA)
    yield connection
    connection.close()


def apply(connection: sqlite3.Connection, change: Change) -> list[str]:
    arrived = msgspec.msgpack.decode(msgspec.msgpack.encode(change), type=Change)
    tables = Tables(SCHEMA)
    tables.check(arrived)
    connection.execute(*tables.statement(arrived))
    return [name for (name,) in connection.execute("SELECT name FROM thing ORDER BY name")]


def test_rows_are_put_and_deleted(connection: sqlite3.Connection) -> None:
    rows = [(name, size, 0, None, None) for size, name in enumerate("abcdef")]
    assert apply(connection, Put("thing", rows)) == list("abcdef")
    assert apply(connection, Put("thing", [("a", 9, 0.5, b"x", "y")])) == list("abcdef")
    assert connection.execute("SELECT * FROM thing WHERE name = 'a'").fetchall() == [("a", 9, 0.5, b"x", "y")]
    assert apply(connection, Delete("thing", [("size", "<=", 2), ("name", "=", "b")])) == list("acdef")
    assert apply(connection, Delete("thing", [("name", ">", "c"), ("name", "<", "f")])) == list("acf")
    assert apply(connection, Delete("thing", [("size", "<", 3)])) == list("af")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (Put("things", [ROW]), "the state has no table 'things'"),
        (Put("sqlite_master", [ROW]), "no table 'sqlite_master'"),
        (Put("journal", [(1, 2)]), "no table 'journal'"),
        (Put("thing VALUES (1); --", [ROW]), "no table"),
        (Put("thing", []), "has 0 rows, not 1 to 64"),
        (Put("thing", [ROW] * (ROWS + 1)), "has 65 rows, not 1 to 64"),
        (Put("thing", [ROW[:-1]]), "a row of thing has 5 values, not 4"),
        (Put("thing", [ROW, (*ROW, 1)]), "a row of thing has 5 values, not 6"),
        (Put("thing", [(None, *ROW[1:])]), "thing.name must have a value"),
        (Put("other", [(None, "x")]), "other.number must have a value"),
        (Put("thing", [(b"a", *ROW[1:])]), "thing.name cannot be of type bytes"),
        (Put("thing", [("a", 1.0, *ROW[2:])]), "thing.size cannot be of type float"),
        (Put("thing", [("a", "1", *ROW[2:])]), "thing.size cannot be of type str"),
        (Put("thing", [("a", 1 << 63, *ROW[2:])]), "thing.size is outside the range of 64 bits"),
        (Put("thing", [("a", 1, float("nan"), None, None)]), "thing.weight is not a number"),
        (Put("thing", [("a", 1, 1.5, "x", None)]), "thing.picture cannot be of type str"),
        (Put("thing", [("a", 1, 1.5, [1], None)]), "thing.picture cannot be of type list"),
        (Put("thing", [("a", 1, 1.5, {"x": 1}, None)]), "thing.picture cannot be of type dict"),
        (Delete("thing", []), "has 0 conditions, not 1 to 16"),
        (Delete("thing", [("size", "=", 1)] * 17), "has 17 conditions, not 1 to 16"),
        (Delete("thing", [("colour", "=", 1)]), "thing has no column 'colour'"),
        (Delete("thing", [("1 OR name", "=", "a")]), "thing has no column '1 OR name'"),
        (Delete("thing", [("note", "=", None)]), "thing.note must have a value"),
        (Delete("thing", [("size", "=", "a")]), "thing.size cannot be of type str"),
    ],
)
def test_a_change_that_does_not_fit_names_the_reason(
    connection: sqlite3.Connection, change: Change, reason: str
) -> None:
    with pytest.raises(ChangeError, match=reason.replace("(", r"\(")):
        apply(connection, change)


@pytest.mark.parametrize("comparison", ["!=", ">=", "LIKE", "= 1 OR 1 =", ""])
def test_a_comparison_is_one_of_four(comparison: str) -> None:
    data = msgspec.msgpack.encode(["delete", "thing", [["size", comparison, 1]]])
    with pytest.raises(msgspec.ValidationError):
        msgspec.msgpack.decode(data, type=Change)


def test_only_consecutive_rows_of_one_table_are_joined() -> None:
    def put(name: str, table: str = "thing") -> Put:
        return Put(table, [(name,)])

    remove = Delete("thing", [("name", "=", "a")])
    pairs: list[tuple[Change, bool]] = [
        (put("a"), True),
        (put("b"), True),
        (remove, True),
        (remove, True),
        (put("c"), True),
        (put("d"), False),
    ]
    expected = [(Put("thing", [("a",), ("b",)]), True), (remove, True), (remove, True), (put("c"), True)]
    assert list(join([*pairs, (put("e", "other"), False)])) == [
        *expected,
        (put("d"), False),
        (put("e", "other"), False),
    ]
    many: list[tuple[Change, bool]] = [(put(str(number)), True) for number in range(2 * ROWS + 1)]
    assert [len(change.rows) for change, _ahead in join(many) if isinstance(change, Put)] == [ROWS, ROWS, 1]
