import base64
import hashlib
import os
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from appliance.audit.log.columns import record_hash
from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import COLUMNS, LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.signatures import KeyUnreadableError, read_public_key
from appliance.audit.proof import verification
from appliance.audit.proof.chain_findings import FindingKind
from appliance.audit.proof.checkpoints import SignerMemory, read_signer_memory
from appliance.audit.proof.copies import signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.base.owner_access import acting_as
from appliance.signing.log_proof import genesis, parse_checkpoint
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.support.requirements import need_root
from tests.unit.audit.conftest import MakeLog

# ruff: noqa: S608  the attacker's statements are built from names of columns

_RECORDS = 200
_UNCOVERED = 5


@pytest.fixture
def log(make_log: MakeLog, path: Path) -> Path:
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
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def found(path: Path, **arguments: Any) -> list[tuple[FindingKind, int, int]]:
    result = verify(path, **arguments)
    assert result.ok == (not result.findings)
    return [(finding.kind, finding.first, finding.last) for finding in result.findings]


@pytest.mark.parametrize(("moment", "signed"), [("_log_id", True), ("_Verifier", False)])
def test_a_first_signature_during_the_verification_has_its_key(
    path: Path, key: Ed25519PrivateKey, monkeypatch: pytest.MonkeyPatch, moment: str, *, signed: bool
) -> None:
    """The verification reads the key after the log, because the key is pinned before its first signature is stored."""
    asked: list[tuple[int, bytes]] = []
    log = AuditLog(path, drive=ByHand, checkpoint_every=5, signer=lambda *one, **_: asked.append(one))
    for number in range(10):
        log.record(decision(log, number))
    assert settle(log) is None
    assert asked
    usual = getattr(verification, moment)

    def sign(*arguments: Any, **options: Any) -> Any:
        for number, text in asked:
            log.store_signature(number, key.sign(text), key.public_key().public_bytes_raw())
        settle(log)
        assert signed_checkpoints(path)
        return usual(*arguments, **options)

    monkeypatch.setattr(verification, moment, sign)
    result = verify(path)
    assert (result.findings, result.signed_checkpoints > 0) == ([], signed)
    log.close()


def test_an_unchanged_log_is_complete(log: Path, key: Ed25519PrivateKey) -> None:
    result = verify(log, key.public_key().public_bytes_raw())
    assert result.ok
    assert result.first == 1
    assert result.records == result.last
    assert result.checkpoints >= 4
    assert result.signed_checkpoints >= 4
    assert result.last - result.signed_through == result.unsealed


@pytest.mark.parametrize("column", COLUMNS.split(", ")[1:])
def test_any_changed_field(log: Path, column: str) -> None:
    kind = "INTEGER" if column in ("time", "version", "rule_line", "revision", "duration_us") else "TEXT"
    value = "4711" if kind == "INTEGER" else ("x'7b7d'" if column == "detail" else "'other'")
    attack(log, f"UPDATE record SET {column} = {value} WHERE sequence = 60")
    assert found(log) == [(FindingKind.CHANGED, 60, 60)]


def test_changed_bytes_of_the_file(log: Path) -> None:
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
        assert any(one.first == 77 or one.kind is FindingKind.STRUCTURE for one in result.findings)


def test_an_inserted_record_with_a_valid_hash_is_found(log: Path) -> None:
    with closing(sqlite3.connect(log)) as connection:
        connection.execute("UPDATE record SET sequence = -sequence WHERE sequence >= 60")
        connection.execute("UPDATE record SET sequence = 1 - sequence WHERE sequence < 0")
        (previous,) = connection.execute("SELECT hash FROM record WHERE sequence = 59").fetchone()
        row = connection.execute(f"SELECT {COLUMNS} FROM record WHERE sequence = 30").fetchone()
        forged = (60, *row[1:])
        marks = ", ".join("?" * (len(forged) + 1))
        connection.execute(f"INSERT INTO record VALUES ({marks})", (*forged, record_hash(previous, forged)))
        connection.commit()
    assert found(log) == [(FindingKind.INSERTED, 60, 60)]


def rewrite(path: Path, start: int) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE record SET decision = 'deny' WHERE sequence = ?", (start,))
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        digest = genesis(log_id)
        for row in connection.execute(f"SELECT {COLUMNS} FROM record ORDER BY sequence").fetchall():
            digest = record_hash(digest, row)
            connection.execute("UPDATE record SET hash = ? WHERE sequence = ?", (digest, row[0]))
        connection.commit()


def test_rewritten_chain_and_checkpoints(log: Path) -> None:
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
    assert FindingKind.SIGNATURE_WRONG in kinds


def test_the_reviewers_key_counts(log: Path) -> None:
    other = Ed25519PrivateKey.generate().public_key().public_bytes_raw()
    assert {kind for kind, _first, _last in found(log, public_key=other)} == {FindingKind.WRONG_KEY}


def signer_memory(log: Path, directory: Path) -> None:
    with closing(sqlite3.connect(log)) as connection:
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        texts = connection.execute("SELECT text FROM checkpoint WHERE signature IS NOT NULL ORDER BY number")
        hashes = b"".join(hashlib.sha256(text).digest() for (text,) in texts)
    directory.mkdir()
    (directory / f"{log_id}.signed").write_bytes((1).to_bytes(8, "big") + hashes)


def test_root_of_a_container_reads_the_signers_memory(log: Path) -> None:
    need_root()
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o711)
        signer_memory(log, folder := Path(name, "signer"))
        (signed,) = folder.iterdir()
        folder.chmod(0o700)
        os.chown(folder, 61015, 61015)
        os.chown(signed, 61015, 61015)
        with acting_as(61099):  # like root without CAP_DAC_OVERRIDE
            with pytest.raises(PermissionError):
                signed.read_bytes()
            memory = read_signer_memory(folder, signed.stem)
        assert memory is not None
        assert memory.last > 1


def test_the_result_says_whether_the_signers_memory_was_compared(log: Path, tmp_path: Path) -> None:
    signer_memory(log, tmp_path / "signer")
    (signed,) = (tmp_path / "signer").iterdir()
    last = len(signed.read_bytes()) // 32
    assert last > 1
    assert verify(log, signer=tmp_path / "signer").remembered == last
    signed.unlink()
    assert verify(log, signer=tmp_path / "signer").remembered == 0
    assert verify(log, signer=tmp_path / "none").remembered is None
    assert verify(log).remembered is None


def test_a_schema_that_is_not_text_is_an_error(log: Path) -> None:
    log.write_bytes(log.read_bytes().replace(b"decision TEXT, host", b"decision TEXT\xac host"))
    with pytest.raises(LogUnreadableError, match=r"audit\.db: damaged: .*; keep it as evidence"):
        verify(log)
    with pytest.raises(LogUnreadableError, match=r"audit\.db: damaged"):
        ChainWriter(log, 0)


def test_a_missing_log_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogUnreadableError, match=r"audit\.db: there is no audit log"):
        verify(tmp_path / "audit.db")
    with pytest.raises(LogUnreadableError, match="is not a state directory"):
        verify(tmp_path / "nowhere" / "audit.db")


def content(path: Path) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as connection:
        records = connection.execute(f"SELECT {COLUMNS}, hash FROM record ORDER BY sequence").fetchall()
        return records + connection.execute("SELECT * FROM checkpoint ORDER BY number").fetchall()


def test_each_changed_byte_is_found_or_harmless(log: Path) -> None:
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
            assert all(finding.message for finding in result.findings)
            found_out += 1
    log.write_bytes(data)
    assert verify(log).ok
    assert found_out > 50


def test_a_clock_set_back_is_valid(make_log: MakeLog, path: Path) -> None:
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
    with closing(sqlite3.connect(log)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    result = verify(log)
    assert not result.ok
    assert msgspec.json.encode(result)


@pytest.mark.parametrize("curve", ["secp256k1", "an unsupported one"])
def test_a_key_of_another_kind_is_an_error(tmp_path: Path, curve: str) -> None:
    public = ec.generate_private_key(ec.SECP256K1()).public_key()
    der = public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if curve != "secp256k1":
        der = der.replace(bytes.fromhex("2b8104000a"), bytes.fromhex("2b8104007a"))
    text = base64.encodebytes(der).decode()
    file = tmp_path / "key.pem"
    file.write_text(f"-----BEGIN PUBLIC KEY-----\n{text}-----END PUBLIC KEY-----\n")
    with pytest.raises(KeyUnreadableError, match=r"key\.pem: not"):
        read_public_key(file)


def test_a_missing_key_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyUnreadableError, match=r"gone\.pem cannot be read: No such file or directory$"):
        read_public_key(tmp_path / "gone.pem")


def unsign(path: Path, first: int) -> None:
    attack(path, f"UPDATE checkpoint SET signature = NULL, public_key = NULL WHERE number >= {first}")


def test_pending_signatures_are_not_tampering(log: Path, tmp_path: Path) -> None:
    signer_memory(log, tmp_path / "signer")
    unsign(log, 2)
    result = verify(log, signer=tmp_path / "signer")
    assert result.findings == []
    assert result.signed_checkpoints == 1
    assert result.unsealed > 100


def test_too_many_missing_signatures_are_found(make_log: MakeLog, path: Path, tmp_path: Path) -> None:
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
    assert kinds == [FindingKind.SIGNATURE_MISSING] * 65


def test_a_checkpoint_made_during_verification_is_not_a_finding(
    log: Path, make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def meanwhile(directory: Path, log_id: str) -> SignerMemory | None:
        writing = make_log(checkpoint_every=10, checkpoint_seconds=3600)
        for number in range(40):
            writing.record(decision(writing, number))
        assert settle(writing) is None
        writing.close()
        signer_memory(log, directory)
        return read_signer_memory(directory, log_id)

    before = verify(log).checkpoints
    monkeypatch.setattr("appliance.audit.proof.verification.read_signer_memory", meanwhile)
    result = verify(log, signer=tmp_path / "signer")
    assert result.findings == []
    assert result.checkpoints > before


def test_findings_are_limited(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.audit.proof.verification._MAX_FINDINGS", 10)
    attack(log, "DELETE FROM record WHERE sequence % 5 = 0 AND sequence <= 150")
    result = verify(log)
    removed = [finding for finding in result.findings if finding.kind is FindingKind.MISSING]
    assert [(one.first, one.last) for one in removed[:10]] == [(5 * n, 5 * n) for n in range(1, 11)]
    assert result.findings[-1].message == "records 55 to 150: 20 further findings, not told one by one"


def test_a_forged_log_does_not_keep_verification_busy(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.audit.proof.verification._MAX_FINDINGS", 3)
    searched: list[int] = []

    def search(rows: list[object], _previous: bytes, place: int) -> list[object]:
        searched.append(place)
        return []

    monkeypatch.setattr("appliance.audit.proof.verification._original_order", search)
    attack(log, "UPDATE record SET hash = randomblob(32)")
    result = verify(log)
    assert len(searched) == 3
    assert [finding.kind for finding in result.findings].count(
        FindingKind.CHANGED
    ) == 4  # the last one is the number of others
    assert "further findings" in result.findings[-1].message
