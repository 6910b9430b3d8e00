import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.retention import Retention
from appliance.audit.proof.chain_findings import FindingKind, Verification
from appliance.audit.proof.copies import (
    SYSLOG_ELEMENT,
    CopiesUnreadableError,
    SignedCheckpoint,
    read_copies,
    signed_checkpoints,
)
from appliance.audit.proof.verification import verify
from appliance.signing.log_proof import ProofFault
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import retain


@pytest.fixture
def log(make_log: MakeLog, path: Path) -> Path:
    log = make_log(checkpoint_every=50, checkpoint_seconds=3600)
    for number in range(200):
        log.record(decision(log, number))
        if number % 25 == 24:
            assert settle(log) is None
    log.close()
    assert verify(path).ok
    return path


def kinds(result: Verification) -> set[FindingKind]:
    assert result.ok == (not result.findings)
    return {finding.kind for finding in result.findings}


def test_an_unchanged_log_agrees(log: Path) -> None:
    copies = signed_checkpoints(log)
    assert len(copies) >= 4
    result = verify(log, copies=copies)
    assert result.ok
    assert result.elsewhere is not None
    assert (result.elsewhere.checkpoints, result.elsewhere.through) == (len(copies), copies[-1].sequence)
    assert result.elsewhere.other_logs == []


def test_a_forged_copy_proves_nothing(log: Path) -> None:
    copies = signed_checkpoints(log)
    forged = msgspec.structs.replace(copies[0], hash="0" * 64)
    result = verify(log, copies=[forged, *copies[1:]])
    assert kinds(result) == {FindingKind.SIGNATURE_WRONG}
    assert result.elsewhere is not None
    assert result.elsewhere.checkpoints == len(copies) - 1


def test_checkpoints_of_removed_records_contradict_nothing(
    make_log: MakeLog, path: Path, notary: Notary
) -> None:
    notary.ago = 2 * 86_400_000_000_000
    log = make_log(checkpoint_every=20, clock=lambda: 1)
    for number in range(60):
        log.record(decision(log, number, time=1))
        settle(log)
    log.close()
    copies = signed_checkpoints(path)
    notary.ago = 0
    log = make_log(checkpoint_every=20, retention=Retention(days=1))
    retain(log)
    log.close()
    newer = signed_checkpoints(path)
    result = verify(path, copies=copies + newer)
    assert result.ok, result.findings
    assert copies[0].sequence <= result.removed
    gone = [copy for copy in copies if copy.sequence < result.removed]
    assert gone
    assert kinds(verify(path, copies=gone)) == {FindingKind.PROVES_NOTHING}


def test_formats_of_a_copy(log: Path, tmp_path: Path) -> None:
    copies = signed_checkpoints(log)
    fields = json.loads(copies[1].as_json())
    element = " ".join(f'{name}="{value}"' for name, value in fields.items())
    file = tmp_path / "kept"
    file.write_text(
        f"{copies[0].as_json()}\n"
        '<110>1 2026-03-01T00:00:00Z robot rosrv - decision [rosrv@32473 x="1"] text\n'
        f"<111>1 2026-03-01T00:00:00Z robot rosrv - checkpoint [{SYSLOG_ELEMENT} {element}] text\n"
        f"{copies[2].as_json()[:50]}\n"
    )
    assert read_copies(file) == copies[:2]


@pytest.mark.parametrize("text", ["", "{}\n", "[" * 100_000, '{"log": 1}\n', "\x00\xff\n"])
def test_a_file_without_checkpoints_is_an_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "kept"
    file.write_text(text)
    with pytest.raises(CopiesUnreadableError, match="kept: no checkpoint"):
        read_copies(file)
    with pytest.raises(CopiesUnreadableError, match="nowhere cannot be read: No such file"):
        read_copies(tmp_path / "nowhere")


@pytest.mark.parametrize("changes", [{"key": "no key"}, {"signature": "none"}, {"hash": "x"}, {"number": -1}])
def test_fields_that_nothing_signs_are_a_fault(log: Path, changes: dict[str, Any]) -> None:
    one = signed_checkpoints(log)[0]
    assert one.fault() is one.fault(one.key) is None
    assert one.fault("no key") is ProofFault.KEY
    changed = msgspec.structs.replace(one, **changes)
    assert changed.fault() is changed.fault(changed.key) is ProofFault.SIGNATURE


def test_json_and_back(log: Path) -> None:
    one = signed_checkpoints(log, limit=1)[0]
    assert msgspec.json.decode(one.as_json(), type=SignedCheckpoint) == one
    assert signed_checkpoints(log, after=one.number)[0].number == one.number + 1
