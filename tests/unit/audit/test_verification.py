"""Tests of finding every way to tamper with a log. The attacker of these tests has the database file."""

import base64
import hashlib
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from appliance.audit.chain import genesis, record_hash
from appliance.audit.chain_findings import Kind
from appliance.audit.checkpoints import Remembered, read_remembered
from appliance.audit.log_database import COLUMNS, LogUnreadableError
from appliance.audit.signatures import KeyUnreadableError, read_public_key
from appliance.audit.verification import verify
from appliance.signing.signed_statements import parse_checkpoint
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog

# ruff: noqa: S608  the attacker's statements are put together from names of columns

_RECORDS = 200
_UNCOVERED = 5


@pytest.fixture
def log(make_log: MakeLog, path: Path) -> Path:
    """A closed log of some hundred records with four signed checkpoints, and some records after the last."""
    log = make_log(checkpoint_every=50, checkpoint_seconds=3600)
    for number in range(_RECORDS):
        log.record(decision(log, number))
        if number % 25 == 24:
            assert settle(log) is None
    assert settle(log) is None
    for number in range(_UNCOVERED):
        log.record(decision(log, number))
    assert settle(log) is None
    log.close()
    assert verify(path).ok
    return path


def attack(path: Path, *statements: str) -> None:
    """Run SQL on the file."""
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def found(path: Path, **arguments: Any) -> list[tuple[Kind, int, int]]:
    """What verification finds."""
    result = verify(path, **arguments)
    assert result.ok == (not result.findings)
    return [(one.kind, one.first, one.last) for one in result.findings]


def test_untouched(log: Path, key: Ed25519PrivateKey) -> None:
    """A log that nobody touched is complete, and the result says how far signatures prove it."""
    result = verify(log, key.public_key().public_bytes_raw())
    assert result.ok
    assert result.first == 1
    assert result.records == result.last
    assert result.checkpoints >= 4
    assert result.signed_checkpoints >= 4
    assert result.last - result.signed_through == result.unsealed


@pytest.mark.parametrize("column", COLUMNS.split(", ")[1:])
def test_any_changed_field(log: Path, column: str) -> None:
    """A change of any field of a record is found, and the record is named."""
    kind = "INTEGER" if column in ("time", "version", "rule_line", "revision", "duration_us") else "TEXT"
    value = "4711" if kind == "INTEGER" else ("x'7b7d'" if column == "detail" else "'other'")
    attack(log, f"UPDATE record SET {column} = {value} WHERE sequence = 60")
    assert found(log) == [(Kind.CHANGED, 60, 60)]


def test_changed_to_null(log: Path) -> None:
    """A field that was taken away is found, as is a null that became an empty text."""
    attack(log, "UPDATE record SET rule = NULL WHERE sequence = 60")
    attack(log, "UPDATE record SET host = '' WHERE event = 'checkpoint' AND sequence < 80")
    kinds = found(log)
    assert (Kind.CHANGED, 60, 60) in kinds
    assert len(kinds) == 2


def test_changed_bytes_of_the_file(log: Path) -> None:
    """A byte changed in the file itself, past SQLite, is found, and the record is named."""
    data = log.read_bytes()
    with closing(sqlite3.connect(log)) as connection:
        (target,) = connection.execute("SELECT id FROM record WHERE sequence = 77").fetchone()
    position = data.rindex(target.encode())  # the newest copy: table or index
    for at in {data.index(target.encode()), position}:
        changed = bytearray(data)
        changed[at] ^= 1
        log.write_bytes(changed)
        result = verify(log)
        assert not result.ok
        assert any(one.first == 77 or one.kind is Kind.STRUCTURE for one in result.findings)


def test_removed_records(log: Path) -> None:
    """Removed records are named: one, and several in a row."""
    attack(log, "DELETE FROM record WHERE sequence = 40 OR sequence BETWEEN 90 AND 95")
    assert found(log) == [(Kind.MISSING, 40, 40), (Kind.MISSING, 90, 95)]


def test_first_records_removed(log: Path) -> None:
    """The beginning of a log cannot be removed without retention's own record of it."""
    attack(log, "DELETE FROM record WHERE sequence <= 10")
    assert (Kind.MISSING, 1, 10) in found(log)


def test_removed_and_renumbered(log: Path) -> None:
    """Closing the gap by renumbering does not hide a removal."""
    attack(
        log,
        "DELETE FROM record WHERE sequence = 40",
        "UPDATE record SET sequence = -sequence WHERE sequence > 40",
        "UPDATE record SET sequence = -1 - sequence WHERE sequence < 0",
    )
    assert (Kind.MISSING, 40, 40) in found(log)
    assert len(found(log)) == 1


def test_inserted(log: Path) -> None:
    """A record pushed in between, the rest renumbered, is found."""
    attack(
        log,
        "UPDATE record SET sequence = -sequence WHERE sequence >= 60",
        "UPDATE record SET sequence = 1 - sequence WHERE sequence < 0",
        f"INSERT INTO record SELECT 60, {COLUMNS.split(', ', 1)[1]}, hash FROM record WHERE sequence = 30",
    )
    assert found(log) == [(Kind.INSERTED, 60, 60)]


def test_inserted_with_a_right_hash(log: Path) -> None:
    """An inserted record that carries a well made hash of its own is found as well."""
    with closing(sqlite3.connect(log)) as connection:
        connection.execute("UPDATE record SET sequence = -sequence WHERE sequence >= 60")
        connection.execute("UPDATE record SET sequence = 1 - sequence WHERE sequence < 0")
        (previous,) = connection.execute("SELECT hash FROM record WHERE sequence = 59").fetchone()
        row = connection.execute(f"SELECT {COLUMNS} FROM record WHERE sequence = 30").fetchone()
        forged = (60, *row[1:])
        marks = ", ".join("?" * (len(forged) + 1))
        connection.execute(f"INSERT INTO record VALUES ({marks})", (*forged, record_hash(previous, forged)))
        connection.commit()
    assert found(log) == [(Kind.INSERTED, 60, 60)]


def test_inserted_before_the_first(log: Path) -> None:
    """A record in front of the first one is found."""
    attack(
        log, f"INSERT INTO record SELECT 0, {COLUMNS.split(', ', 1)[1]}, hash FROM record WHERE sequence = 9"
    )
    assert found(log) == [(Kind.INSERTED, 0, 0)]


@pytest.mark.parametrize(("one", "other"), [(60, 61), (60, 67)])
def test_reordered(log: Path, one: int, other: int) -> None:
    """Two records that changed places are found, side by side or not."""
    attack(
        log,
        f"UPDATE record SET sequence = -1 WHERE sequence = {one}",
        f"UPDATE record SET sequence = {one} WHERE sequence = {other}",
        f"UPDATE record SET sequence = {other} WHERE sequence = -1",
    )
    assert found(log) == [(Kind.REORDERED, one, other)]


def test_end_removed(log: Path) -> None:
    """Records cut off after a checkpoint was made over them are found."""
    last = verify(log).last
    attack(log, "DELETE FROM record WHERE sequence > 150")
    kinds = found(log)
    assert all(kind in (Kind.TRUNCATED, Kind.CHECKPOINT_MISSING) for kind, _first, _last in kinds)
    truncated = [(first, end) for kind, first, end in kinds if kind is Kind.TRUNCATED]
    assert truncated
    assert all(first == 151 and end <= last for first, end in truncated)


def rewrite(path: Path, start: int) -> None:
    """Change a record and make every hash from there on anew, as an attacker who knows the program would."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE record SET decision = 'deny' WHERE sequence = ?", (start,))
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        digest = genesis(log_id)
        for row in connection.execute(f"SELECT {COLUMNS} FROM record ORDER BY sequence").fetchall():
            digest = record_hash(digest, row)
            connection.execute("UPDATE record SET hash = ? WHERE sequence = ?", (digest, row[0]))
        connection.commit()


def test_rewritten_chain(log: Path) -> None:
    """A history written anew with right hashes throughout does not agree with the checkpoints."""
    rewrite(log, 60)
    result = verify(log)
    assert not result.ok
    assert {one.kind for one in result.findings} == {Kind.CHECKPOINT_CHANGED}


def test_rewritten_chain_and_checkpoints(log: Path) -> None:
    """Checkpoints written anew as well do not have right signatures."""
    rewrite(log, 60)
    with closing(sqlite3.connect(log)) as connection:
        for number, text in connection.execute("SELECT number, text FROM checkpoint").fetchall():
            old = parse_checkpoint(text)
            query = "SELECT hash FROM record WHERE sequence = ?"
            (digest,) = connection.execute(query, (old.sequence,)).fetchone()
            new = old._replace(hash=digest.hex()).text()
            connection.execute("UPDATE checkpoint SET text = ? WHERE number = ?", (new, number))
        connection.commit()
    kinds = {kind for kind, _first, _last in found(log)}
    assert Kind.SIGNATURE_WRONG in kinds


def test_signed_with_another_key(log: Path) -> None:
    """Checkpoints signed by somebody else's key are found."""
    other = Ed25519PrivateKey.generate()
    with closing(sqlite3.connect(log)) as connection:
        for number, text in connection.execute("SELECT number, text FROM checkpoint").fetchall():
            connection.execute(
                "UPDATE checkpoint SET signature = ?, public_key = ? WHERE number = ?",
                (other.sign(text), other.public_key().public_bytes_raw(), number),
            )
        connection.commit()
    assert {kind for kind, _first, _last in found(log)} == {Kind.WRONG_KEY}


def test_expected_key_is_another(log: Path) -> None:
    """A key given by the reviewer counts, whatever is pinned beside the log."""
    other = Ed25519PrivateKey.generate().public_key().public_bytes_raw()
    assert {kind for kind, _first, _last in found(log, public_key=other)} == {Kind.WRONG_KEY}


def test_pinned_key_removed(log: Path) -> None:
    """Without any key signatures prove nothing, and that is said."""
    log.with_name("audit.pub").unlink()
    assert Kind.NO_KEY in {kind for kind, _first, _last in found(log)}


@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("UPDATE checkpoint SET text = CAST(replace(text, 'time 1', 'time 2') AS BLOB) WHERE number = 2",
         Kind.SIGNATURE_WRONG),
        ("UPDATE checkpoint SET text = x'00' WHERE number = 2", Kind.CHECKPOINT_CHANGED),
        ("UPDATE checkpoint SET sequence = sequence - 1 WHERE number = 2", Kind.CHECKPOINT_CHANGED),
        ("UPDATE checkpoint SET signature = zeroblob(64) WHERE number = 2", Kind.SIGNATURE_WRONG),
        ("DELETE FROM checkpoint WHERE number = 2", Kind.CHECKPOINT_MISSING),
    ],
)  # fmt: skip
def test_changed_checkpoint(log: Path, statement: str, kind: Kind) -> None:
    """Whatever is done to a checkpoint is found, and its number is named."""
    attack(log, statement)
    assert (kind, 2, 2) in found(log)


def test_last_checkpoints_removed(log: Path) -> None:
    """The chain has a record of each checkpoint, so the last ones cannot be removed alone."""
    last = verify(log).checkpoints
    attack(log, f"DELETE FROM checkpoint WHERE number = {last}")
    assert found(log) == [(Kind.CHECKPOINT_MISSING, last, last)]


def signer_memory(log: Path, directory: Path) -> None:
    """What the signer of this log remembers: it signed every checkpoint of it."""
    with closing(sqlite3.connect(log)) as connection:
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        texts = connection.execute("SELECT text FROM checkpoint WHERE signature IS NOT NULL ORDER BY number")
        hashes = b"".join(hashlib.sha256(text).digest() for (text,) in texts)
    directory.mkdir()
    (directory / f"{log_id}.signed").write_bytes((1).to_bytes(8, "big") + hashes)


@pytest.mark.parametrize(
    ("statements", "kind"),
    [
        (("DELETE FROM record WHERE sequence > 90", "DELETE FROM checkpoint WHERE sequence > 90"),
         Kind.CHECKPOINT_MISSING),
        (("UPDATE checkpoint SET signature = NULL, public_key = NULL WHERE number = 2",),
         Kind.SIGNATURE_MISSING),
    ],
)  # fmt: skip
def test_held_against_the_signer(log: Path, tmp_path: Path, statements: tuple[str, ...], kind: Kind) -> None:
    """What the log alone cannot show, its end cut off with its checkpoints, the signer's memory does."""
    signer_memory(log, tmp_path / "signer")
    assert found(log, signer=tmp_path / "signer") == []
    attack(log, *statements)
    assert kind in {one for one, _first, _last in found(log, signer=tmp_path / "signer")}


def hide_in_index(path: Path) -> None:
    """Empty an index, so that search finds nothing by it, and leave the records as they are."""
    attack(
        path,
        "PRAGMA writable_schema = ON",
        "UPDATE sqlite_schema SET sql = replace(sql, 'NOT NULL', 'NULL') WHERE name = 'record_decision'",
    )


@pytest.mark.parametrize(
    "tamper",
    [
        hide_in_index,
        lambda path: attack(path, "DROP INDEX record_host"),
        lambda path: attack(path, "CREATE TABLE extra (x)"),
        lambda path: attack(path, "CREATE TRIGGER t AFTER INSERT ON record BEGIN DELETE FROM record; END"),
    ],
    ids=["index changed", "index removed", "table added", "trigger added"],
)
def test_structure(log: Path, tamper: Callable[[Path], None]) -> None:
    """Changes of the database around the records, which could hide them from a search, are found."""
    tamper(log)
    assert Kind.STRUCTURE in {kind for kind, _first, _last in found(log)}


@pytest.mark.parametrize("sequence", [3, 100, 190])
def test_overwritten_page(log: Path, sequence: int) -> None:
    """A part of the file overwritten with rubbish is found, and verification ends in an orderly way."""
    with closing(sqlite3.connect(log)) as connection:
        (target,) = connection.execute("SELECT hash FROM record WHERE sequence = ?", (sequence,)).fetchone()
    with log.open("r+b") as file:
        file.seek(log.read_bytes().index(target) // 4096 * 4096)
        file.write(b"\xa5" * 600)
    try:
        assert not verify(log).ok
    except LogUnreadableError as error:
        assert str(log) in str(error)


def test_cut_file(log: Path) -> None:
    """A file cut in the middle is found."""
    data = log.read_bytes()
    log.write_bytes(data[: len(data) // 2 // 4096 * 4096])
    try:
        assert not verify(log).ok
    except LogUnreadableError as error:
        assert str(log) in str(error)


def test_missing_log(tmp_path: Path) -> None:
    """No log is an error that names the file."""
    with pytest.raises(LogUnreadableError, match=r"audit\.db: there is no audit log"):
        verify(tmp_path / "audit.db")
    with pytest.raises(LogUnreadableError, match="no such directory"):
        verify(tmp_path / "nowhere" / "audit.db")


def content(path: Path) -> list[tuple[object, ...]]:
    """All that a reviewer can read: records and checkpoints."""
    with closing(sqlite3.connect(path)) as connection:
        records = connection.execute(f"SELECT {COLUMNS}, hash FROM record ORDER BY sequence").fetchall()
        return records + connection.execute("SELECT * FROM checkpoint ORDER BY number").fetchall()


def test_altered_byte_by_byte(log: Path) -> None:
    """Bytes all over the file, altered one at a time: each is found, or changes nothing that anybody reads."""
    before, data = content(log), log.read_bytes()
    found_out = 0
    for position in range(7, len(data), len(data) // 250):
        changed = bytearray(data)
        changed[position] ^= 0x55
        log.write_bytes(changed)
        try:
            result = verify(log)
        except LogUnreadableError:
            found_out += 1
            continue
        if result.ok:
            assert content(log) == before, f"byte {position} of {len(data)}"
        else:
            assert all(one.message for one in result.findings)
            found_out += 1
    log.write_bytes(data)
    assert verify(log).ok
    assert found_out > 50


def test_a_clock_that_was_set_back(make_log: MakeLog, path: Path) -> None:
    """Records of a clock that jumped into the past are in the order they were made, and the log is whole."""
    now = [2_000_000_000_000_000_000]
    log = make_log(clock=lambda: now[0], checkpoint_every=10)
    for number in range(30):
        log.record(decision(log, number, time=now[0]))
        if number == 15:
            now[0] -= 10**18  # thirty years
        assert settle(log) is None
    log.close()
    result = verify(path)
    assert result.ok, result.findings
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT sequence, id, time FROM record WHERE event = 'decision' ORDER BY sequence"
        rows = connection.execute(query).fetchall()
    assert len(rows) == 30
    assert [row[1] for row in rows] == sorted(row[1] for row in rows)
    assert min(row[2] for row in rows) < max(row[2] for row in rows) - 9 * 10**17


_NESTED = f"CAST('{'[' * 100_000}{']' * 100_000}' AS BLOB)"
_REMOVED = (
    '{"first_sequence":1,"last_sequence":5,"last_hash":"%s","first_time":1,"last_time":2,"last_checkpoint":0,'
    '"last_checkpoint_hash":"%s"}'
)


@pytest.mark.parametrize(
    "statements",
    [
        ("DELETE FROM log",), ("DROP TABLE log",), ("DROP TABLE record",), ("DROP TABLE checkpoint",),
        ("INSERT INTO log VALUES ('00000000000000000000000000000000', 1)",),
        ("UPDATE log SET id = CAST(x'ff' AS TEXT)",),
        ("UPDATE log SET id = '../../../etc/passwd'",),
        ("UPDATE record SET detail = CAST('{\"number\":\"x\",\"hash\":1}' AS BLOB) WHERE event = 'checkpoint'",),
        ("UPDATE record SET detail = CAST('{\"number\":[1],\"hash\":1}' AS BLOB) WHERE event = 'checkpoint'",),
        (f"UPDATE record SET detail = {_NESTED} WHERE event = 'checkpoint'",),
        (f"UPDATE record SET event = 'records removed', detail = {_NESTED} WHERE sequence = 60",),
        *(
            (f"UPDATE record SET event = 'records removed', detail = CAST('{detail}' AS BLOB) WHERE sequence = 60",)
            for detail in (
                _REMOVED % ("zz", "0" * 64),
                (_REMOVED % ("0" * 64, "0" * 64)).replace('"last_sequence":5', '"last_sequence":"q"'),
                (_REMOVED % ("0" * 64, "0" * 64)).replace('"last_checkpoint":0', '"last_checkpoint":"q"'),
                "[]",
            )
        ),
        (
            "CREATE TABLE other AS SELECT * FROM record",
            "DROP TABLE record",
            "ALTER TABLE other RENAME TO record",
            "UPDATE record SET hash = 'text' WHERE sequence = 60",
        ),
        (
            "CREATE TABLE other AS SELECT * FROM checkpoint",
            "DROP TABLE checkpoint",
            "ALTER TABLE other RENAME TO checkpoint",
            "UPDATE checkpoint SET signature = 'text', text = 7",
        ),
    ],
)  # fmt: skip
def test_hostile_content_has_a_verdict(log: Path, statements: tuple[str, ...]) -> None:
    """Whatever stands in the tables, verification ends with findings in words that can be sent on."""
    with closing(sqlite3.connect(log)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    result = verify(log)
    assert not result.ok
    assert msgspec.json.encode(result)


@pytest.mark.parametrize("curve", ["secp256k1", "an unsupported one"])
def test_a_key_of_another_kind(tmp_path: Path, curve: str) -> None:
    """A key file with a key of any other kind is refused in words."""
    public = ec.generate_private_key(ec.SECP256K1()).public_key()
    der = public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if curve != "secp256k1":
        der = der.replace(bytes.fromhex("2b8104000a"), bytes.fromhex("2b8104007a"))
    text = base64.encodebytes(der).decode()
    file = tmp_path / "key.pem"
    file.write_text(f"-----BEGIN PUBLIC KEY-----\n{text}-----END PUBLIC KEY-----\n")
    with pytest.raises(KeyUnreadableError, match=r"key\.pem: not"):
        read_public_key(file)


def test_a_key_that_is_not_there(tmp_path: Path) -> None:
    """The file is named, and what is wrong with it in words."""
    with pytest.raises(KeyUnreadableError, match=r"gone\.pem: No such file or directory$"):
        read_public_key(tmp_path / "gone.pem")


def unsign(path: Path, first: int) -> None:
    """Take the signatures from the checkpoint `first` on away."""
    attack(path, f"UPDATE checkpoint SET signature = NULL, public_key = NULL WHERE number >= {first}")


def test_signatures_on_their_way(log: Path, tmp_path: Path) -> None:
    """What the signer has signed and the log does not have yet, at its end, is no tampering."""
    signer_memory(log, tmp_path / "signer")
    unsign(log, 2)
    result = verify(log, signer=tmp_path / "signer")
    assert result.findings == []
    assert result.signed_checkpoints == 1
    assert result.unsealed > 100


def test_more_signatures_missing_than_are_asked_for(make_log: MakeLog, path: Path, tmp_path: Path) -> None:
    """More of them at the end than are ever on their way together were removed."""
    log = make_log(checkpoint_every=1, checkpoint_seconds=3600)
    for number in range(70):
        log.record(decision(log, number))
        assert settle(log) is None
    log.close()
    signer_memory(path, tmp_path / "signer")
    assert found(path, signer=tmp_path / "signer") == []
    checkpoints = verify(path).checkpoints
    unsign(path, checkpoints - 63)
    assert found(path, signer=tmp_path / "signer") == []
    unsign(path, checkpoints - 64)
    kinds = [kind for kind, _first, _last in found(path, signer=tmp_path / "signer")]
    assert kinds == [Kind.SIGNATURE_MISSING] * 65


def test_signed_while_it_is_verified(
    log: Path, make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint that is made and signed while verification begins is not taken for one cut off."""

    def meanwhile(directory: Path, log_id: str) -> Remembered | None:
        writing = make_log(checkpoint_every=10, checkpoint_seconds=3600)
        for number in range(40):
            writing.record(decision(writing, number))
        assert settle(writing) is None
        writing.close()
        signer_memory(log, directory)
        return read_remembered(directory, log_id)

    before = verify(log).checkpoints
    monkeypatch.setattr("appliance.audit.verification.read_remembered", meanwhile)
    result = verify(log, signer=tmp_path / "signer")
    assert result.findings == []
    assert result.checkpoints > before


def test_more_findings_than_are_told(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a log with findings without end the first are told, and how many more there are, up to which record."""
    monkeypatch.setattr("appliance.audit.verification._MOST_FINDINGS", 10)
    attack(log, "DELETE FROM record WHERE sequence % 5 = 0 AND sequence <= 150")
    result = verify(log)
    removed = [one for one in result.findings if one.kind is Kind.MISSING]
    assert [(one.first, one.last) for one in removed[:10]] == [(5 * n, 5 * n) for n in range(1, 11)]
    assert result.findings[-1].message == "records 55 to 150: 20 further findings, not told one by one"
