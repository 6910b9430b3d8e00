"""An export can be verified on another machine with only the public key, whatever its filter was."""

import json
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record_format import as_json
from appliance.audit.log.retention import Retention
from appliance.audit.log.signatures import read_public_key
from appliance.audit.proof.chain_proofs import evidence, evidence_line
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.evidence.export_verification import (
    ExportUnreadableError,
    ExportVerification,
    gaps,
    verify_export,
)
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import first_sequence, make_old, retain

STRANGE: dict[str, Any] = {
    "text": 'é"\\\n\x1b',
    "number": 0.1,
    "large": 1e300,
    "deep": {"b": [1, None], "a": True},
}
OLD_LOG = Path(__file__).with_name("log-0.1.0.db.xz")


@pytest.fixture
def log(make_log: MakeLog, path: Path) -> Path:
    """Return a log of over two hundred records with a seal every fifty and a denial every ten."""
    log = make_log(checkpoint_every=50, checkpoint_seconds=3600)
    for number in range(200):
        verdict = "deny" if number % 10 == 3 else "allow"
        log.record(decision(log, number, decision=verdict, resource=f"/r{number}", detail=STRANGE))
        if number % 25 == 24:
            assert settle(log) is None
    log.close()
    return path


@pytest.fixture
def public(key: Ed25519PrivateKey) -> bytes:
    """Return the reviewer's copy of the key."""
    return key.public_key().public_bytes_raw()


def exported(log: Path, wanted: Filter, page: int = 1000) -> list[dict[str, Any]]:
    """Return the lines of an export."""
    return [json.loads(evidence_line(*one)) for one in evidence(log, wanted, page)]


def checked(
    lines: list[dict[str, Any]], place: Path, key: bytes, *, excerpt: bool = True
) -> ExportVerification:
    """Return a reviewer's findings in a file of these lines."""
    place.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return verify_export(place, key, excerpt=excerpt)


@pytest.mark.nightly
@pytest.mark.parametrize("wanted", [Filter(), Filter(decision=("deny",)), Filter(resource="/r77")])
@pytest.mark.parametrize("page", [1000, 7])
def test_it_verifies_elsewhere(log: Path, public: bytes, tmp_path: Path, wanted: Filter, page: int) -> None:
    """With and without a filter, each record leads to a signed checkpoint, in pages of any size."""
    lines = exported(log, wanted, page)
    result = checked(lines, tmp_path / "x.ndjson", public)
    assert result.ok, result.findings
    assert result.records == len(lines) == sum(1 for _ in export(log, wanted))
    assert result.proven + result.unsealed == result.records
    assert result.proven > 0.8 * result.records
    assert len(result.logs) == 1


def test_a_line_is_a_record_with_its_position(log: Path) -> None:
    """Each line of an export is the record as a search returns it, with its position as an added field."""
    for (entry, _chain), line in zip(evidence(log, Filter()), exported(log, Filter()), strict=True):
        chain = line.pop("chain")
        assert line == json.loads(as_json(entry))
        assert set(chain) >= {"previous", "hash", "then"}


@pytest.mark.parametrize(
    ("left_out", "excerpt", "found"), [(0, False, 0), (1, False, 1), (1, True, 0), (0, True, 0)]
)
def test_a_gap_is_a_finding_unless_it_is_declared(left_out: int, found: int, *, excerpt: bool) -> None:
    """Nothing in an export tells a record that was removed from one that a filter left out."""
    result = ExportVerification(key="", records=3 - left_out, first=7, last=9, left_out=left_out)
    assert (
        gaps(result, excerpt=excerpt)
        == ["1 records from 7 to 9 are missing: if a filter left them out, give --excerpt"] * found
    )


@pytest.mark.nightly
@pytest.mark.parametrize("excerpt", [False, True])
def test_only_an_excerpt_may_lack_records(log: Path, public: bytes, tmp_path: Path, *, excerpt: bool) -> None:
    """Records that a filter left out look like records that were removed, so an excerpt is declared."""
    whole = checked(exported(log, Filter()), tmp_path / "x.ndjson", public, excerpt=excerpt)
    assert (whole.ok, whole.left_out) == (True, 0)
    part = checked(exported(log, Filter(decision=("deny",))), tmp_path / "y.ndjson", public, excerpt=excerpt)
    assert part.left_out > 0
    assert part.proven > 0
    assert part.ok is excerpt
    assert ["--excerpt" in finding for finding in part.findings] == [True] * (not excerpt)


def _change(lines: list[dict[str, Any]]) -> None:
    lines[3]["decision"] = "allow"


def _rename(lines: list[dict[str, Any]]) -> None:
    lines[3]["detail"]["text"] = "other"


def _drop(lines: list[dict[str, Any]]) -> None:
    del lines[2]


def _swap(lines: list[dict[str, Any]]) -> None:
    lines[1], lines[2] = lines[2], lines[1]


def _double(lines: list[dict[str, Any]]) -> None:
    lines.insert(2, lines[1])


def _renumber(lines: list[dict[str, Any]]) -> None:
    lines[4]["sequence"] += 1


def _shorten(lines: list[dict[str, Any]]) -> None:
    next(line for line in lines if len(line["chain"]["then"]) > 1)["chain"]["then"].pop()


def _reseal(lines: list[dict[str, Any]]) -> None:
    line = next(line for line in lines if line["chain"].get("checkpoint"))
    line["chain"]["checkpoint"]["sequence"] -= 1


def _sign_otherwise(lines: list[dict[str, Any]]) -> None:
    for line in lines:
        if line["chain"].get("checkpoint"):
            line["chain"]["checkpoint"]["signature"] = "no signature"


@pytest.mark.nightly
@pytest.mark.parametrize(
    "tamper", [_change, _rename, _drop, _swap, _double, _renumber, _shorten, _reseal, _sign_otherwise]
)
def test_tampering_is_found(
    log: Path, public: bytes, tmp_path: Path, tamper: Callable[[list[dict[str, Any]]], None]
) -> None:
    """A changed, dropped, swapped, doubled or renumbered record, a shorter chain and another seal are each found."""
    lines = exported(log, Filter(decision=("deny",)))
    tamper(lines)
    assert not checked(lines, tmp_path / "x.ndjson", public).ok


@pytest.mark.nightly
def test_a_rehashed_record_leads_to_no_checkpoint(log: Path, public: bytes, tmp_path: Path) -> None:
    """A forger who recomputes the hashes of the whole export cannot sign a checkpoint."""
    forged_log = AuditLog(tmp_path / "forged.db", drive=ByHand, checkpoint_every=5)
    for number in range(20):
        forged_log.record(decision(forged_log, number))
    settle(forged_log)
    forged_log.close()
    result = checked(exported(tmp_path / "forged.db", Filter()), tmp_path / "x.ndjson", public)
    assert result.proven == 0
    assert ["no signed checkpoint" in finding for finding in result.findings] == [True]
    other = Ed25519PrivateKey.generate().public_key().public_bytes_raw()
    genuine = checked(exported(log, Filter()), tmp_path / "y.ndjson", other)
    assert all("is not signed with the key" in finding for finding in genuine.findings)
    assert genuine.proven == 0


@pytest.mark.nightly
@pytest.mark.parametrize("text", ["", "{}\n", "no json\n", '{"chain": {}}\n', "[]\n"])
def test_other_files_are_not_valid_exports(tmp_path: Path, public: bytes, text: str) -> None:
    """A file without records, or whose records have no positions, is never a valid export."""
    file = tmp_path / "x.ndjson"
    file.write_text(text)
    if text:
        with pytest.raises(ExportUnreadableError, match=r"x\.ndjson:1"):
            verify_export(file, public, excerpt=False)
    else:
        assert not verify_export(file, public, excerpt=False).ok
    with pytest.raises(ExportUnreadableError, match="No such file"):
        verify_export(tmp_path / "missing", public, excerpt=False)


@pytest.mark.nightly
def test_an_export_after_retention_is_proved(
    make_log: MakeLog, path: Path, public: bytes, notary: Notary
) -> None:
    """The records that retention left can be proved, from the first to the last."""
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    log.record(decision(log))
    retain(log)
    assert first_sequence(path) > 1900
    for number in range(200):
        log.record(decision(log, number))
    settle(log)
    retain(log)
    result = checked(exported(path, Filter()), path.with_name("x.ndjson"), public)
    assert result.proven
    log.close()
    assert result.ok, result.findings


@pytest.mark.nightly
def test_a_log_of_version_0_1_0(path: Path, tmp_path: Path) -> None:
    """A whole export of such a log is proved; for a filtered export the result says that it cannot be proved."""
    path.write_bytes(lzma.decompress(OLD_LOG.read_bytes()))
    old_key = read_public_key(OLD_LOG.with_name("log-0.1.0.pub"))
    whole = checked(exported(path, Filter()), tmp_path / "x.ndjson", old_key)
    assert whole.ok, whole.findings
    assert whole.proven > 0
    part = checked(exported(path, Filter(resource="/cmd_3")), tmp_path / "y.ndjson", old_key)
    assert part.findings
    assert all("lead to no checkpoint; version 0.1.0 wrote later records" in text for text in part.findings)
