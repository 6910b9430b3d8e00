import contextlib
import copy
import os
import random
import signal
import sqlite3
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from appliance.master.parameter_mirror import ParameterMirror
from appliance.policy.model import address_of
from appliance.store.changes import Encoded, WriteAhead
from appliance.store.state_file import (
    LARGEST_CHANGE,
    SCHEMA,
    IncarnationRow,
    PermissionRow,
    RegistrationRow,
    RevisionRow,
    StateStore,
)
from roswire.parameter_tree import Tree
from roswire.xmlrpc import Value
from tests.support.engines import InlineDatabase
from tests.support.parameters import mirror, put

INTEGRATION = Path(__file__).parents[2] / "integration"


def incarnation(key: str) -> IncarnationRow:
    return IncarnationRow(
        key, "/talker", "10.0.0.1", "http://robot:4711/", "10.0.0.2", 19001, 19002, False, "live", 1.5
    )


def reopened(directory: Path) -> StateStore:
    return StateStore(directory, failed=pytest.fail, kind=InlineDatabase)


def leave_behind(directory: Path, changes: Sequence[Encoded]) -> None:
    ahead = WriteAhead(directory / "state.ahead")
    ahead.append(changes)
    ahead.close()


def killed_after(work: Callable[[StateStore], None], directory: Path) -> None:
    child = os.fork()
    if not child:
        try:
            work(reopened(directory))
            os.kill(os.getpid(), signal.SIGKILL)
        finally:  # only when something failed there
            traceback.print_exc()
            os._exit(1)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL


def columns_of(script: str) -> dict[str, list[tuple[str, str, int, int]]]:
    columns: dict[str, list[tuple[str, str, int, int]]] = {}
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(script)
        for table, *column in connection.execute(
            'SELECT t.name, c.name, c.type, c."notnull", c.pk FROM sqlite_master AS t'
            " JOIN pragma_table_info(t.name) AS c WHERE t.type = 'table' ORDER BY t.name, c.cid"
        ):
            columns.setdefault(table, []).append((column[0], column[1], column[2], column[3]))
    return columns


def test_the_tables_of_a_released_version_keep_their_columns() -> None:
    """A standby of the next version stores the rows of the active appliance; new values need a new table."""
    released = columns_of((INTEGRATION / "state-0.4.1.sql").read_text())
    del released["journal"], released["token_left"]  # the latter was empty since 0.4
    present = columns_of(SCHEMA)
    assert released == {table: present.get(table) for table in released}


def test_the_registry_comes_back_as_it_was(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    store.save_incarnation(incarnation("k1"))
    second = RegistrationRow("k1", "publication", "/b", "std_msgs/String", 2)
    first = RegistrationRow("k1", "subscription", "/a", "std_msgs/String", 1)
    store.save_registration(second)
    store.save_registration(first)
    store.close()
    again = reopened(tmp_path)
    assert again.load_registry() == ([incarnation("k1")], [first, second])
    again.close()


def test_changes_of_a_killed_process_are_applied_from_any_of_them_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes: list[Encoded] = []
    append = WriteAhead.append

    def observed(ahead: WriteAhead, together: Sequence[Encoded]) -> None:
        changes.extend(together)
        append(ahead, together)

    monkeypatch.setattr(WriteAhead, "append", observed)
    node = incarnation("k1")._replace(more_relay_ports=(19003, 19004))
    registration = RegistrationRow("k1", "publication", "/a", "*", 1)
    grant = PermissionRow("k1", "topic", "/a", "10.0.0.9", "/listener")
    store = reopened(tmp_path)
    store.save_incarnation(node)
    store.save_registration(registration)
    store.save_permission(grant)
    store.note_parameter("/a", 1)
    store.parameter_owned("/a", "10.0.0.8")
    store.parameters_disowned("/a")
    store.parameter_owned("/a/b", "10.0.0.9")
    store.save_revision(RevisionRow(1, "text", "p.ini", 1.0, "disk", "note"))
    store.save_setting("name", "value")
    store.save_incarnation(node)
    store.close()
    monkeypatch.undo()
    for stored in range(len(changes) + 1):
        directory = tmp_path / str(stored)
        directory.mkdir()
        leave_behind(directory, changes[:stored])
        reopened(directory).close()
        leave_behind(directory, changes)
        again = reopened(directory)
        assert again.load_registry() == ([node], [registration])
        assert again.permissions() == [grant]
        assert again.parameter_changes() == [("/a", 1)]
        assert again.parameter_owners() == [("/a/b", "10.0.0.9")]
        again.close()


def test_forgetting_an_incarnation_removes_its_rows(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    for key in ("k1", "k2"):
        store.save_incarnation(incarnation(key))
        store.save_registration(RegistrationRow(key, "publication", "/a", "*", 1))
        store.save_permission(PermissionRow(key, "topic", "/a", "10.0.0.9", "/listener"))
    store.forget_incarnation("k1")
    store.close()
    again = reopened(tmp_path)
    incarnations, registrations = again.load_registry()
    assert [row.key for row in incarnations] == ["k2"]
    assert [row.key for row in registrations] == ["k2"]
    assert [row.key for row in again.permissions()] == ["k2"]
    again.close()


def test_parameters_keep_their_types(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    assert store.load_parameters() == {}
    tree: dict[str, Value] = {"a": {"b": [1, 2.5, True, "x", b"\x00\xff"]}, "empty": {}, "nan_free": -(2**31)}
    store.save_parameters(tree)
    store.close()
    again = reopened(tmp_path)
    assert again.load_parameters() == tree
    again.close()


def test_revisions_are_listed_newest_first(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    rows = [RevisionRow(n, f"text {n}", "p.ini", float(n), "disk", "note") for n in (1, 2, 3)]
    for row in rows:
        store.save_revision(row)
    store.close()
    again = reopened(tmp_path)
    assert again.revisions() == rows[::-1]
    again.close()


@pytest.mark.nightly
def test_a_parameter_that_was_just_set_outlasts_the_process(tmp_path: Path) -> None:
    def first(store: StateStore) -> None:
        store.save_parameters({"a": 1})
        store.note_parameter("/b", [1.5, {"c": b"x"}])
        store.note_parameter("/a", None)

    def second(store: StateStore) -> None:
        assert store.parameter_changes() == [("/b", [1.5, {"c": b"x"}]), ("/a", None)]
        store.note_parameter("/d", 3)

    killed_after(first, tmp_path)
    killed_after(second, tmp_path)
    last = reopened(tmp_path)
    assert last.parameter_changes() == [("/b", [1.5, {"c": b"x"}]), ("/a", None), ("/d", 3)]
    last.close()


@pytest.mark.nightly
def test_owners_of_parameters_outlast_the_process(tmp_path: Path) -> None:
    def first(store: StateStore) -> None:
        for key in ("/", "/a", "/a/b", "/a/b/c", "/a/bc", "/ab", "/a-", "/b"):
            store.parameter_owned(key, "10.0.0.9")
        store.parameters_disowned("/a/b")
        store.parameter_owned("/b", "10.0.0.8")

    def second(store: StateStore) -> None:
        kept = dict.fromkeys(("/", "/a", "/a/bc", "/ab", "/a-"), "10.0.0.9") | {"/b": "10.0.0.8"}
        assert dict(store.parameter_owners()) == kept
        store.parameters_disowned("/")

    killed_after(first, tmp_path)
    killed_after(second, tmp_path)
    last = reopened(tmp_path)
    assert last.parameter_owners() == []
    last.close()


def test_saving_the_tree_removes_its_earlier_changes(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    store.note_parameter("/a", 1)
    store.save_parameters({"a": 1})
    store.note_parameter("/b", 2)
    store.close()
    again = reopened(tmp_path)
    assert (again.load_parameters(), again.parameter_changes()) == ({"a": 1}, [("/b", 2)])
    again.close()


def test_a_large_value_is_kept_with_the_tree(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    due: list[bool] = []
    for value in ("small", "x" * LARGEST_CHANGE):
        store.note_parameter("/map", value)
        due.append(store.tree_is_due)
    assert store.parameter_changes() == [("/map", "small")]
    store.save_parameters({"map": "x" * LARGEST_CHANGE})
    assert [*due, store.tree_is_due] == [False, True, False]
    store.close()
    again = reopened(tmp_path)
    assert again.parameter_changes() == []
    again.close()


def test_a_standby_gets_each_large_value_once(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    store.note_whole_parameters()
    feed = store.database.follow(lambda: None, 1 << 30)
    for number in range(12):
        store.note_parameter(f"/map{number % 4}", f"{number}" * (6 << 20))
        assert not store.tree_is_due
    sent = sum(len(f"{number}") * (6 << 20) for number in range(12))
    assert sent < feed.size < sent + (64 << 10)
    assert [key for key, _value in store.parameter_changes()] == ["/map0", "/map1", "/map2", "/map3"]
    store.close()


def test_changes_of_many_keys_end_in_the_tree(tmp_path: Path) -> None:
    store = reopened(tmp_path)
    due = [store.tree_is_due]
    for number in range(10_001):
        due[1:] = [store.tree_is_due]
        store.note_parameter(f"/key{number}", None)
    due.append(store.tree_is_due)
    store.save_parameters({})
    assert [*due, store.tree_is_due] == [False, False, True, False]
    store.close()


@pytest.mark.parametrize("seed", range(20))
def test_replaced_changes_give_the_same_tree(seed: int, tmp_path: Path) -> None:
    chance, names = random.Random(seed), ("a", "b", "c")  # noqa: S311  no secret
    tree: Tree = {"a": {"b": {"c": 1}}, "b": 5}
    store = reopened(tmp_path)
    store.save_parameters(copy.deepcopy(tree))
    for _process in range(3):
        there = _mirror(store)
        assert there.tree == tree
        for _ in range(40):
            key = "/" + "/".join(chance.choices(names, k=chance.randint(1, 3)))
            if chance.random() < 0.4:
                there.delete(key)
            else:
                values: list[Value] = [chance.randint(0, 9), {"a": chance.randint(0, 9)}, {}]
                put(there, key, chance.choice(values), address_of("10.0.0.1"))
        tree = there.tree
        store.close()
        store = reopened(tmp_path)
    assert _mirror(store).tree == tree
    store.close()


def _mirror(store: StateStore) -> ParameterMirror:
    return mirror(
        store.load_parameters(), note=store.note_parameter, together=store.database.together,
        since=store.parameter_changes(),
    )  # fmt: skip
