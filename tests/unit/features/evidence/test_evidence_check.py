import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rosrv_fleet.config import EvidenceConfig, FleetConfig
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.evidence.check import EvidenceError, check_evidence
from rosrv_fleet.evidence.store import EvidenceContent
from rosrv_fleet.workers import Workers

from tests.unit.features.evidence.conftest import Control
from tests.unit.features.evidence.test_bundle import members_of, written

pytestmark = pytest.mark.nightly


@pytest.fixture
def workers() -> Iterator[Workers]:
    made = Workers(1)
    yield made
    made.close()


def checked(workers: Workers, bundle: Path, key: Ed25519PrivateKey, seconds: float = 30.0) -> EvidenceContent:
    folder, raw = bundle.parent, key.public_key().public_bytes_raw().hex()
    evidence = EvidenceConfig(check_seconds=seconds)
    config = FleetConfig(certificate=folder, key=folder, data=folder / "data", evidence=evidence)
    robot = Robot(name="arm1", key=raw, certificate="", added=0)
    return workers.submit(check_evidence, config, bundle, robot).result(120)


def test_a_bundle_cannot_use_up_the_memory(
    control: Control, key: Ed25519PrivateKey, workers: Workers, tmp_path: Path
) -> None:
    bundle, bomb = control.exported(tmp_path / "bundle.zip"), tmp_path / "bomb.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members_of(bundle).items():
            archive.writestr(name, b"[" + b"[]," * 5_000_000 + b"[]]" if name == "manifest.json" else data)
    assert bomb.stat().st_size < 1 << 20
    with pytest.raises(EvidenceError, match=r"manifest\.json: cannot be read: MemoryError"):
        checked(workers, bomb, key)
    runs = json.loads(members_of(bundle)["manifest.json"])["runs"]
    assert checked(workers, bundle, key).records == sum(last - first + 1 for first, last in runs) >= 20


def test_a_bundle_cannot_use_up_the_time(
    control: Control, key: Ed25519PrivateKey, workers: Workers, tmp_path: Path
) -> None:
    members, bomb = members_of(control.exported(tmp_path / "bundle.zip")), tmp_path / "bomb.zip"
    manifest = json.loads(members["manifest.json"])
    names = [f"policies/{number}.ini" for number in range(100, 105)]
    manifest["members"] |= {name: {"sha256": "", "bytes": 0} for name in names}
    members |= {"manifest.json": json.dumps(manifest).encode(), **dict.fromkeys(names, bytes(200_000_000))}
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(EvidenceError, match=r"it took more than 0\.1 s of processor time"):
        checked(workers, bomb, key, 0.1)


def test_findings_are_few_and_short(
    control: Control, key: Ed25519PrivateKey, workers: Workers, tmp_path: Path
) -> None:
    members = members_of(control.exported(tmp_path / "bundle.zip"))
    members |= {f"\x1b{number}{'x' * 5000}": b"" for number in range(50)}
    with pytest.raises(EvidenceError) as error:
        checked(workers, written(members, tmp_path / "many.zip"), key)
    found = str(error.value).split("; ")
    assert len(found) == 11
    assert found[-1].endswith(" more")
    assert all(len(one) < 400 and one.isprintable() for one in found)
