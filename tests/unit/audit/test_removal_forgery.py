"""Who can write the log takes out what just happened and has the log say that it was old: verification finds it."""

import lzma
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.chain_findings import Kind, Verification
from appliance.audit.copies import signed_checkpoints
from appliance.audit.log import AuditLog
from appliance.audit.log_writer import ChainWriter, RemovedRange
from appliance.audit.query import Filter
from appliance.audit.record import Record, Severity
from appliance.audit.retention import Retention
from appliance.audit.search import export, search
from appliance.audit.verification import verify
from appliance.signing.signed_statements import Removal
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.test_retention import await_removal, make_old

OLD_LOG = Path(__file__).with_name("log-0.1.0.db.xz")


def kinds(result: Verification) -> set[Kind]:
    """What was found."""
    return {one.kind for one in result.findings}


def forge(path: Path, proof: dict[str, object] | None = None) -> RemovedRange:
    """Remove all that can be, as the program does, with a record that gives age as the reason."""
    writer = ChainWriter(path, 0)
    gone = writer.removable(1 << 30, signed=True)
    assert gone is not None
    detail = gone._asdict() | {"count": gone.last_sequence - gone.first_sequence + 1} | (proof or {})
    report = Record(
        id=f"{time.time_ns():016x}0000", time=time.time_ns(), event="records removed", severity=Severity.NOTICE,
        reason="older than 30.0 days", detail=detail,
    )  # fmt: skip
    writer.remove(gone, report)
    writer.close()
    return gone


@pytest.fixture
def fresh(make_log: MakeLog, path: Path) -> Path:
    """A log that is seconds old, with a denial at its beginning; retention is off."""
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
    """The log alone shows it: its checkpoints say that nothing was removed, and no signature says otherwise."""
    forge(fresh)
    result = verify(fresh)
    assert kinds(result) == {Kind.REMOVAL_UNFOUNDED}
    assert (result.removal, result.ok) == ("unsigned", False)


def test_with_the_signers_memory_and_copies_elsewhere_it_is_found(fresh: Path, notary: Notary) -> None:
    """Neither the signer's memory nor copies of checkpoints are silenced by a removal."""
    copies = signed_checkpoints(fresh)
    forge(fresh)
    with closing(sqlite3.connect(fresh)) as attacker:
        attacker.execute("DELETE FROM checkpoint")
        attacker.commit()
    assert Kind.REMOVAL_UNFOUNDED in kinds(verify(fresh, signer=notary.directory))
    assert Kind.REMOVAL_UNFOUNDED in kinds(verify(fresh, copies=copies))
    gone = [one for one in copies if one.sequence < verify(fresh).removed]
    assert {Kind.REMOVAL_UNFOUNDED, Kind.PROVES_NOTHING} <= kinds(verify(fresh, copies=gone))


@pytest.mark.parametrize("whose", ["own", "nobody's", "another's"])
def test_a_signature_of_somebody_else_does_not_help(fresh: Path, whose: str) -> None:
    """The forger's own key, rubbish, and a signature over something else are no signature of the signer."""
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
    assert kinds(verify(fresh)) == {Kind.REMOVAL_UNFOUNDED}


def test_a_signed_removal_vouches_for_no_other(make_log: MakeLog, path: Path, notary: Notary) -> None:
    """After retention removed old records in earnest, the same signature does not carry a removal of new ones."""
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    log.record(decision(log, decision="deny", host="10.0.0.66"))
    await_removal(path, 1900)
    for number in range(300):
        log.record(decision(log, number))
        if number % 100 == 99:
            settle(log)
    log.close()
    assert verify(path).ok
    assert verify(path).removal == "signed"
    genuine = search(path, Filter(event="records removed")).entries[0].record.detail
    forge(path, {name: genuine[name] for name in ("limit", "signature", "key")})
    assert kinds(verify(path)) == {Kind.REMOVAL_UNFOUNDED}


def test_the_log_asks_in_vain_for_what_does_not_follow(make_log: MakeLog, path: Path, notary: Notary) -> None:
    """A control that wants more removed than the signer's settings say gets no signature, and nothing goes."""
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    notary.kept = type(notary.kept)()  # for ever
    log.record(decision(log))
    settle(log)
    deadline = time.monotonic() + 30
    while log.degraded is None:
        assert time.monotonic() < deadline
        log.record(decision(log))
        settle(log)
    assert "the signer refuses" in log.degraded
    log.close()
    assert next(export(path, Filter())).sequence == 1
    assert verify(path).ok


# --- logs of version 0.1.0, whose removals are not signed ---


@pytest.fixture
def old(path: Path) -> Path:
    """A log that version 0.1.0 wrote, with a removal by retention."""
    path.write_bytes(lzma.decompress(OLD_LOG.read_bytes()))
    path.with_name("audit.pub").write_bytes(OLD_LOG.with_name("log-0.1.0.pub").read_bytes())
    return path


def test_an_old_log_is_right_as_far_as_it_goes(old: Path) -> None:
    """A log of before removals were signed is whole, and it is said that nothing vouches for what was removed."""
    result = verify(old)
    assert result.ok, result.findings
    assert (result.removed, result.removal) == (68, "unsigned")
    copies = signed_checkpoints(old)
    assert verify(old, copies=copies).ok
    assert {one.removed for one in copies} == {None}


def test_an_old_log_is_written_on(old: Path) -> None:
    """This version goes on in it; from its first checkpoint on, a further removal must be signed."""
    log = AuditLog(old, checkpoint_every=10)
    for number in range(50):
        log.record(decision(log, number))
        settle(log)
    assert log.close() is None
    result = verify(old)
    assert result.ok, result.findings
    assert (result.removed, result.removal) == (68, "unsigned")
