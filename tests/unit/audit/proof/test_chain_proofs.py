import json
import lzma
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.columns import to_columns
from appliance.audit.log.record_format import as_json
from appliance.audit.log.retention import Retention
from appliance.audit.log.signatures import read_public_key, write_public_key
from appliance.audit.proof.chain_proofs import evidence, evidence_line, stored_line
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.formats.bundle_verifier import Verifier
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import first_sequence, make_old, retain

STRANGE: dict[str, Any] = {
    "text": 'é"\\\n\x1b',
    "number": 0.1,
    "large": 1e300,
    "deep": {"b": [1, None], "a": True},
}
ALL = Filter()
OLD_LOG = Path(__file__).with_name("log-0.1.0.db.xz")


@pytest.fixture
def log(make_log: MakeLog, path: Path) -> Path:
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
    return key.public_key().public_bytes_raw()


def checked(
    log: Path, folder: Path, key: bytes, wanted: Filter = ALL, page: int = 1000
) -> tuple[int, list[str]]:
    write_public_key(folder / "audit.pub", key)
    lines, sealed, logs = [], 0, {""}
    for entry, chain in evidence(log, wanted, page):
        lines.append(stored_line(to_columns(entry.record, entry.sequence), chain))
        if chain.checkpoint is not None:
            sealed, logs = len(lines), {chain.checkpoint.log}
    (folder / "records.ndjson").write_bytes(b"".join(lines[:sealed]))
    verifier = Verifier(folder, None, folder, {})
    verifier.manifest = {"log": logs.pop()}
    return len(list(verifier.records("records.ndjson"))), verifier.findings


@pytest.mark.nightly
@pytest.mark.parametrize("wanted", [Filter(), Filter(decision=("deny",)), Filter(resource="/r77")])
@pytest.mark.parametrize("page", [1000, 7])
def test_it_verifies_elsewhere(log: Path, public: bytes, tmp_path: Path, wanted: Filter, page: int) -> None:
    proven, findings = checked(log, tmp_path, public, wanted, page)
    assert not findings
    assert proven > 0.8 * sum(1 for _ in export(log, wanted))


def test_a_line_is_a_record_with_its_position(log: Path) -> None:
    for entry, chain in evidence(log, ALL):
        line = json.loads(evidence_line(entry, chain))
        assert set(line.pop("chain")) >= {"previous", "hash", "then"}
        assert line == json.loads(as_json(entry))


@pytest.mark.nightly
def test_an_export_after_retention_is_proved(
    make_log: MakeLog, path: Path, public: bytes, notary: Notary, tmp_path: Path
) -> None:
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    log.record(decision(log))
    retain(log)
    assert first_sequence(path) > 1900
    for number in range(200):
        log.record(decision(log, number))
    settle(log)
    retain(log)
    proven, findings = checked(path, tmp_path, public)
    log.close()
    assert proven
    assert not findings


@pytest.mark.nightly
def test_a_log_of_version_0_1_0(path: Path, tmp_path: Path) -> None:
    path.write_bytes(lzma.decompress(OLD_LOG.read_bytes()))
    old_key = read_public_key(OLD_LOG.with_name("log-0.1.0.pub"))
    proven, findings = checked(path, tmp_path, old_key)
    assert proven
    assert not findings
    _, findings = checked(path, tmp_path, old_key, Filter(resource="/cmd_3"))
    assert findings
    assert all("lead to no checkpoint; version 0.1.0 wrote later records" in text for text in findings)
