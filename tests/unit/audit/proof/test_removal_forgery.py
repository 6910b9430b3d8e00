import lzma
import sqlite3
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import LogUnreadableError, open_for_reading
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.retention import RemovedRange, Retention
from appliance.audit.proof.chain_findings import FindingKind, Verification
from appliance.audit.proof.copies import signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export, search
from appliance.base import clock
from appliance.signing.log_proof import Removal
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import first_sequence, make_old, retain

OLD_LOG = Path(__file__).with_name("log-0.1.0.db.xz")


def kinds(result: Verification) -> set[FindingKind]:
    return {finding.kind for finding in result.findings}


def forge(path: Path, proof: dict[str, object] | None = None) -> RemovedRange:
    writer = ChainWriter(path, 0)
    gone = writer.removable(1 << 30, signed=True)
    assert gone is not None
    detail = (
        msgspec.to_builtins(gone) | {"count": gone.last_sequence - gone.first_sequence + 1} | (proof or {})
    )
    report = AuditRecord(
        id=f"{clock.wall_ns():016x}0000", time=clock.wall_ns(), event="records removed", severity=Severity.NOTICE,
        reason="older than 30.0 days", detail=detail,
    )  # fmt: skip
    writer.remove(gone, report)
    writer.close()
    return gone


@pytest.fixture
def fresh(make_log: MakeLog, path: Path) -> Path:
    log = make_log(checkpoint_every=20)
    log.record(decision(log, decision="deny", host="10.0.0.66"))
    for number in range(100):
        log.record(decision(log, number))
        if number % 20 == 19:
            assert settle(log) is None
    log.close()
    assert verify(path).ok
    return path


def test_a_forged_removal_is_found(fresh: Path) -> None:
    forge(fresh)
    result = verify(fresh)
    assert kinds(result) == {FindingKind.REMOVAL_UNFOUNDED}
    assert (result.removal, result.ok) == ("unsigned", False)


def test_the_signer_and_copies_find_it_too(fresh: Path, notary: Notary) -> None:
    copies = signed_checkpoints(fresh)
    forge(fresh)
    with closing(sqlite3.connect(fresh)) as attacker:
        attacker.execute("DELETE FROM checkpoint")
        attacker.commit()
    assert FindingKind.REMOVAL_UNFOUNDED in kinds(verify(fresh, signer=notary.directory))
    assert FindingKind.REMOVAL_UNFOUNDED in kinds(verify(fresh, copies=copies))
    gone = [copy for copy in copies if copy.sequence < verify(fresh).removed]
    assert {FindingKind.REMOVAL_UNFOUNDED, FindingKind.PROVES_NOTHING} <= kinds(verify(fresh, copies=gone))


@pytest.mark.parametrize("whose", ["own", "nobody's", "another's"])
def test_another_signature_does_not_help(fresh: Path, whose: str) -> None:
    with closing(sqlite3.connect(fresh)) as connection:
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        query = "SELECT signature FROM checkpoint WHERE signature IS NOT NULL LIMIT 1"
        (of_a_checkpoint,) = connection.execute(query).fetchone()
    text = Removal(log_id, 1, 20, "0" * 64, "0" * 64, "30.0 days").text()
    own = Ed25519PrivateKey.generate()
    signature = {
        "own": own.sign(text).hex(),
        "nobody's": "not hexadecimal",
        "another's": of_a_checkpoint.hex(),
    }
    forge(fresh, {"limit": "30.0 days", "signature": signature[whose]})
    assert kinds(verify(fresh)) == {FindingKind.REMOVAL_UNFOUNDED}


def test_a_signed_removal_covers_no_other(make_log: MakeLog, path: Path, notary: Notary) -> None:
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    log.record(decision(log, decision="deny", host="10.0.0.66"))
    retain(log)
    assert first_sequence(path) > 1900
    for number in range(300):
        log.record(decision(log, number))
        if number % 100 == 99:
            settle(log)
    log.close()
    assert verify(path).ok
    assert verify(path).removal == "signed"
    genuine = search(path, Filter(event="records removed")).entries[0].record.detail
    forge(path, {name: genuine[name] for name in ("limit", "signature", "key")})
    assert kinds(verify(path)) == {FindingKind.REMOVAL_UNFOUNDED}


def test_the_signer_refuses_removals_beyond_its_settings(
    make_log: MakeLog, path: Path, notary: Notary
) -> None:
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    notary.kept = type(notary.kept)()  # forever
    log.record(decision(log))
    settle(log)
    retain(log)
    assert "the signer refuses" in (log.degraded or "")
    log.close()
    assert next(export(path, Filter())).sequence == 1
    assert verify(path).ok


# --- logs of version 0.1.0, whose removals are not signed ---


@pytest.fixture
def old(path: Path) -> Path:
    path.write_bytes(lzma.decompress(OLD_LOG.read_bytes()))
    path.with_name("audit.pub").write_bytes(OLD_LOG.with_name("log-0.1.0.pub").read_bytes())
    return path


def test_a_log_that_only_0_1_0_opened_names_the_remedy(old: Path) -> None:
    with closing(sqlite3.connect(old)) as database:
        database.execute("PRAGMA user_version = 1")
    with pytest.raises(
        LogUnreadableError, match=r"version 0\.1\.0 of rosrv; start version 0\.2\.0 on it once"
    ):
        open_for_reading(old)


def test_an_old_log_is_valid_with_a_note(old: Path) -> None:
    result = verify(old)
    assert result.ok, result.findings
    assert (result.removed, result.removal) == (68, "unsigned")
    copies = signed_checkpoints(old)
    assert verify(old, copies=copies).ok
    assert {copy.removed for copy in copies} == {None}


def test_an_old_log_is_continued(old: Path) -> None:
    log = AuditLog(old, drive=ByHand, checkpoint_every=10)
    for number in range(50):
        log.record(decision(log, number))
        settle(log)
    assert log.close() is None
    result = verify(old)
    assert result.ok, result.findings
    assert (result.removed, result.removal) == (68, "unsigned")
