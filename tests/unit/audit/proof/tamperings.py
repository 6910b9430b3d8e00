"""Tamperings with an audit log, by a program that imports nothing of the appliance: it knows SQLite, and the formats.

`of_the_log` are by an attacker who may write the folder of the log, `of_root` by one who may also read the signer's key
and write the signer's memory. Each takes the state directory; `before` has a copy of it from an earlier time.
"""

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

# ruff: noqa: S608  the attacker's statements

Attack = Callable[[Path, Path], None]
of_the_log: dict[str, Attack] = {}
of_root: dict[str, Attack] = {}

_FIELDS = (
    "id, time, version, event, severity, decision, host, caller_id, category, resource, rule, rule_key, rule_file,"
    " rule_line, revision, reason, duration_us, detail"
)
_NEXT = "(SELECT max(sequence) + 1 FROM record)"
_RENUMBER_UP = (
    "UPDATE record SET sequence = -sequence WHERE sequence >= {first}",
    "UPDATE record SET sequence = {by} - sequence WHERE sequence < 0",
)


def _log(state: Path) -> Path:
    return state / "control" / "audit.db"


def _sql(state: Path, *statements: str) -> None:
    with closing(sqlite3.connect(_log(state))) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def _statements(name: str, *statements: str) -> None:
    of_the_log[name] = lambda state, _before: _sql(state, *statements)


def attack(attack: Attack) -> Attack:
    of_the_log[attack.__name__.replace("_", " ")] = attack
    return attack


def as_root(attack: Attack) -> Attack:
    of_root[attack.__name__.replace("_", " ")] = attack
    return attack


# --- rows ---

_statements("turn a denial into an allow", "UPDATE record SET decision = 'allow' WHERE sequence = 60")
_statements("blame another host", "UPDATE record SET host = '10.0.0.99' WHERE sequence = 60")
_statements("blame another node", "UPDATE record SET caller_id = '/other' WHERE sequence = 60")
_statements("name another topic", "UPDATE record SET resource = '/harmless' WHERE sequence = 60")
_statements("name another rule", "UPDATE record SET rule_line = 1 WHERE sequence = 60")
_statements("name another revision of the policy", "UPDATE record SET revision = 1 WHERE sequence = 60")
_statements("rewrite a reason", "UPDATE record SET reason = 'nothing' WHERE sequence = 60")
_statements(
    "move a record to another hour", "UPDATE record SET time = time - 3600000000000 WHERE sequence = 60"
)
_statements(
    "make an intervention a decision", "UPDATE record SET event = 'decision' WHERE event = 'monitor disabled'"
)
_statements("make an alarm harmless", "UPDATE record SET severity = 'debug' WHERE event = 'monitor disabled'")
_statements(
    "blame another person",
    "UPDATE record SET detail = x'7b2277686f223a22626f62227d' WHERE event = 'monitor disabled'",
)
_statements("empty the details", "UPDATE record SET detail = x'7b7d' WHERE event = 'monitor disabled'")
_statements("replace an id", "UPDATE record SET id = 'ffffffffffffffffffff' WHERE sequence = 60")
_statements("replace a hash", "UPDATE record SET hash = x'" + "00" * 32 + "' WHERE sequence = 60")
_statements("make an empty field NULL", "UPDATE record SET resource = NULL WHERE sequence = 60")
_statements("make a NULL an empty field", "UPDATE record SET host = '' WHERE sequence = 1 AND host IS NULL")
_statements("delete a record", "DELETE FROM record WHERE sequence = 60")
_statements("delete a range", "DELETE FROM record WHERE sequence BETWEEN 60 AND 79")
_statements("delete the beginning", "DELETE FROM record WHERE sequence <= 20")
_statements("delete the end", "DELETE FROM record WHERE sequence > 150")
_statements(
    "delete the end and its checkpoints",
    "DELETE FROM record WHERE sequence > 110", "DELETE FROM checkpoint WHERE sequence > 110",
)  # fmt: skip
_statements("delete all records of a host", "DELETE FROM record WHERE host = '10.0.0.2'")
_statements(
    "delete each order that disabled a monitor", "DELETE FROM record WHERE event = 'monitor disabled'"
)
_statements(
    "delete a record and renumber the rest",
    "DELETE FROM record WHERE sequence = 60", *(one.format(first=61, by=-1) for one in _RENUMBER_UP),
)  # fmt: skip
_statements(
    "swap neighbours",
    "UPDATE record SET sequence = -1 WHERE sequence = 60", "UPDATE record SET sequence = 60 WHERE sequence = 61",
    "UPDATE record SET sequence = 61 WHERE sequence = -1",
)  # fmt: skip
_statements(
    "swap distant records",
    "UPDATE record SET sequence = -1 WHERE sequence = 30", "UPDATE record SET sequence = 30 WHERE sequence = 120",
    "UPDATE record SET sequence = 120 WHERE sequence = -1",
)  # fmt: skip
_statements(
    "swap the times of two records",
    "UPDATE record SET time = (SELECT sum(time) FROM record WHERE sequence IN (60, 90)) - time"
    " WHERE sequence IN (60, 90)",
)
_statements(
    "duplicate a record at the end",
    f"INSERT INTO record SELECT {_NEXT}, {_FIELDS}, hash FROM record WHERE sequence = 60",
)
_statements(
    "duplicate a record in place",
    *(one.format(first=61, by=1) for one in _RENUMBER_UP),
    f"INSERT INTO record SELECT 61, {_FIELDS}, hash FROM record WHERE sequence = 60",
)
_statements(
    "insert before the first record",
    f"INSERT INTO record SELECT 0, {_FIELDS}, hash FROM record WHERE sequence = 9",
)
_statements(
    "insert far before", f"INSERT INTO record SELECT -5, {_FIELDS}, hash FROM record WHERE sequence = 9"
)
_statements(
    "insert an excuse with a hash of its own",
    *(one.format(first=60, by=1) for one in _RENUMBER_UP),
    f"INSERT INTO record SELECT 60, {_FIELDS}, randomblob(32) FROM record WHERE sequence = 30",
    "UPDATE record SET reason = 'ordered by the safety officer' WHERE sequence = 60",
)
_statements("append a record with a hash of its own", (
    f"INSERT INTO record SELECT (SELECT max(sequence) + 1 FROM record), {_FIELDS}, randomblob(32) FROM record"
    " WHERE sequence = 60"
))  # fmt: skip

# --- segments: the records between two checkpoints, 50 in this log ---

_FIRST, _SECOND, _THIRD = (
    "sequence BETWEEN 2 AND 51",
    "sequence BETWEEN 52 AND 101",
    "sequence BETWEEN 102 AND 151",
)
_statements("truncate a segment", "DELETE FROM record WHERE sequence BETWEEN 80 AND 101")
_statements(
    "remove a segment with its checkpoint",
    f"DELETE FROM record WHERE {_SECOND}",
    "DELETE FROM checkpoint WHERE number = 2",
)
_statements(
    "remove a segment and close the gap",
    f"DELETE FROM record WHERE {_SECOND}", "DELETE FROM checkpoint WHERE number = 2",
    *(one.format(first=102, by=-50) for one in _RENUMBER_UP),
    "UPDATE checkpoint SET sequence = sequence - 50 WHERE number > 2",
    "UPDATE checkpoint SET number = number - 1 WHERE number > 2",
)  # fmt: skip
_statements(
    "swap two segments",
    f"UPDATE record SET sequence = -(sequence + 50) WHERE {_SECOND}",
    f"UPDATE record SET sequence = sequence - 50 WHERE {_THIRD}",
    "UPDATE record SET sequence = -sequence WHERE sequence < 0",
)  # fmt: skip
_statements(
    "replay an old segment in place of a later one",
    f"DELETE FROM record WHERE {_THIRD}",
    f"INSERT INTO record SELECT sequence + 50, {_FIELDS}, hash FROM record WHERE {_SECOND}",
)
_statements(
    "replay an old segment at the end",
    f"INSERT INTO record SELECT sequence + {_NEXT} - 52, {_FIELDS}, hash FROM record WHERE {_SECOND}",
)

# --- checkpoints ---

_statements(
    "alter a checkpoint's hash",
    "UPDATE checkpoint SET text = CAST(replace(CAST(text AS TEXT), 'hash ', 'hash 0') AS BLOB) WHERE number = 2",
)
_statements(
    "alter a checkpoint's time",
    "UPDATE checkpoint SET text = CAST(replace(CAST(text AS TEXT), 'time 1', 'time 2') AS BLOB) WHERE number = 2",
)
_statements("move a checkpoint", "UPDATE checkpoint SET sequence = sequence - 1 WHERE number = 2")
_statements("remove a checkpoint", "DELETE FROM checkpoint WHERE number = 2")
_statements(
    "remove the last checkpoint",
    "DELETE FROM checkpoint WHERE number = (SELECT max(number) FROM checkpoint)",
)
_statements("remove all checkpoints", "DELETE FROM checkpoint")
_statements(
    "swap two checkpoints",
    "UPDATE checkpoint SET number = -1 WHERE number = 2", "UPDATE checkpoint SET number = 2 WHERE number = 3",
    "UPDATE checkpoint SET number = 3 WHERE number = -1",
)  # fmt: skip
_statements(
    "repeat a checkpoint",
    "INSERT INTO checkpoint SELECT (SELECT max(number) + 1 FROM checkpoint), sequence, text, signature, public_key"
    " FROM checkpoint WHERE number = 1",
)
_statements(
    "remove a signature", "UPDATE checkpoint SET signature = NULL, public_key = NULL WHERE number = 2"
)
_statements("alter a signature", "UPDATE checkpoint SET signature = randomblob(64) WHERE number = 2")
_statements(
    "say that retention removed the beginning",
    "DELETE FROM record WHERE sequence <= 51", "DELETE FROM checkpoint WHERE number <= 1",
    "UPDATE record SET event = 'records removed' WHERE sequence = 152",
)  # fmt: skip

# --- the key, the log as a whole, the file ---


def _signed_again(state: Path, key: Ed25519PrivateKey) -> None:
    public = key.public_key().public_bytes_raw()
    with closing(sqlite3.connect(_log(state))) as connection:
        for number, text in connection.execute("SELECT number, text FROM checkpoint").fetchall():
            row = (key.sign(text), public, number)
            connection.execute("UPDATE checkpoint SET signature = ?, public_key = ? WHERE number = ?", row)
        connection.commit()


def _write_key(path: Path, key: Ed25519PrivateKey) -> None:
    path.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))


@attack
def sign_with_another_key(state: Path, _before: Path) -> None:
    _signed_again(state, Ed25519PrivateKey.generate())


@attack
def replace_the_key_beside_the_log(state: Path, _before: Path) -> None:
    _write_key(state / "control" / "audit.pub", Ed25519PrivateKey.generate())


@attack
def replace_the_identity_of_the_log(state: Path, _before: Path) -> None:
    """All signatures and the key beside the log are of another key: nothing in the log's folder contradicts them."""
    key = Ed25519PrivateKey.generate()
    _signed_again(state, key)
    _write_key(state / "control" / "audit.pub", key)


@attack
def remove_the_key_beside_the_log(state: Path, _before: Path) -> None:
    (state / "control" / "audit.pub").unlink()


@attack
def rewrite_the_chain_from_a_record_on(state: Path, _before: Path) -> None:
    with closing(sqlite3.connect(_log(state))) as connection:
        connection.execute("UPDATE record SET decision = 'allow' WHERE sequence = 60")
        _linked_again(connection)
        connection.commit()


def _linked_again(connection: sqlite3.Connection) -> None:
    (log,) = connection.execute("SELECT id FROM log").fetchone()
    previous = hashlib.sha256(b"rosrv audit log\n" + log.encode()).digest()
    for row in connection.execute(f"SELECT sequence, {_FIELDS} FROM record ORDER BY sequence").fetchall():
        content = hashlib.sha256(msgspec.msgpack.encode(row)).digest()
        previous = hashlib.sha256(previous + b"2" + content).digest()
        connection.execute("UPDATE record SET hash = ? WHERE sequence = ?", (previous, row[0]))


@attack
def restore_a_backup(state: Path, before: Path) -> None:
    """Only of the log's folder: the signer's is not writable."""
    shutil.rmtree(state / "control")
    shutil.copytree(before / "control", state / "control")


@attack
def put_the_log_of_another_machine_in_its_place(state: Path, _before: Path) -> None:
    _sql(state, "UPDATE log SET id = '" + "ab" * 16 + "'")


@attack
def give_the_log_two_ids(state: Path, _before: Path) -> None:
    _sql(state, "INSERT INTO log VALUES ('" + "ab" * 16 + "', 1)")


@attack
def flip_a_bit_of_the_file(state: Path, _before: Path) -> None:
    data = bytearray(_log(state).read_bytes())
    data[data.index(b"/cmd_7 by node 7")] ^= 1
    _log(state).write_bytes(data)


@attack
def cut_the_file(state: Path, _before: Path) -> None:
    data = _log(state).read_bytes()
    _log(state).write_bytes(data[: len(data) // 2])


@attack
def overwrite_a_page(state: Path, _before: Path) -> None:
    data = bytearray(_log(state).read_bytes())
    data[8192:12288] = bytes(4096)
    _log(state).write_bytes(data)


_statements("hide a host from searches: drop an index", "DROP INDEX record_host")
_statements(
    "hide denials from searches: empty an index",
    "PRAGMA writable_schema = ON",
    "UPDATE sqlite_schema SET sql = replace(sql, 'NOT NULL', 'NULL') WHERE name = 'record_decision'",
)
_statements(
    "let new records vanish: add a trigger",
    "CREATE TRIGGER t AFTER INSERT ON record BEGIN DELETE FROM record; END",
)
_statements(
    "show a view in place of the records",
    "ALTER TABLE record RENAME TO hidden",
    "CREATE VIEW record AS SELECT * FROM hidden WHERE event != 'monitor disabled'",
)  # fmt: skip
_statements(
    "let the records have no end",
    "DROP TABLE record",
    "CREATE VIEW record AS WITH RECURSIVE n(sequence) AS (VALUES (1) UNION ALL SELECT sequence + 1 FROM n)"
    " SELECT sequence, x'00' AS hash FROM n",
)


@attack
def put_a_pipe_in_place_of_the_log(state: Path, _before: Path) -> None:
    _log(state).unlink()
    os.mkfifo(_log(state))


@attack
def put_a_pipe_beside_the_log(state: Path, _before: Path) -> None:
    _log(state).with_name("audit.db-wal").unlink(missing_ok=True)
    os.mkfifo(_log(state).with_name("audit.db-wal"))


_statements("keep something else in the log", "CREATE TABLE extra (x)")

# --- root ---


@as_root
def remove_the_memory(state: Path, _before: Path) -> None:
    for file in (state / "signer").glob("*.signed"):
        file.unlink()


@as_root
def empty_the_signers_folder_and_its_memory(state: Path, _before: Path) -> None:
    for file in (state / "signer").iterdir():
        file.unlink()


@as_root
def cut_the_memory(state: Path, _before: Path) -> None:
    for file in (state / "signer").glob("*.signed"):
        data = file.read_bytes()
        file.write_bytes((2).to_bytes(8, "big") + data[40:])


@as_root
def restore_a_backup_of_all(state: Path, before: Path) -> None:
    shutil.rmtree(state)
    shutil.copytree(before, state)


@as_root
def rewrite_history_with_the_key(state: Path, _before: Path) -> None:
    """Records, checkpoints, signatures and memory agree: only copies on another machine do not."""
    key = Ed25519PrivateKey.from_private_bytes((state / "signer" / "audit.key").read_bytes())
    public, memory, previous = key.public_key().public_bytes_raw(), (1).to_bytes(8, "big"), "0" * 64
    with closing(sqlite3.connect(_log(state))) as connection:
        connection.execute("UPDATE record SET decision = 'allow' WHERE sequence = 60")
        _linked_again(connection)
        for number, sequence, text in connection.execute(
            "SELECT number, sequence, text FROM checkpoint"
        ).fetchall():
            lines = dict(line.split(" ", 1) for line in text.decode().splitlines())
            (digest,) = connection.execute(
                "SELECT hash FROM record WHERE sequence = ?", (sequence,)
            ).fetchone()
            lines |= {"hash": digest.hex(), "previous": previous}
            new = "".join(f"{name} {value}\n" for name, value in lines.items()).encode()
            previous = hashlib.sha256(new).hexdigest()
            memory += bytes.fromhex(previous)
            row = (new, key.sign(new), public, number)
            connection.execute(
                "UPDATE checkpoint SET text = ?, signature = ?, public_key = ? WHERE number = ?", row
            )
        connection.commit()
    for file in (state / "signer").glob("*.signed"):
        file.write_bytes(memory)


@as_root
def begin_a_new_log_and_forget_the_old_one(state: Path, _before: Path) -> None:
    shutil.rmtree(state / "signer")
    (state / "signer").mkdir()
    _sql(
        state, "DELETE FROM record WHERE sequence > 60", "DELETE FROM checkpoint WHERE sequence > 60",
        "UPDATE checkpoint SET signature = NULL, public_key = NULL",
    )  # fmt: skip
