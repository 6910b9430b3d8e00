from pathlib import Path

import msgspec
import pytest
from rosrv_fleet.evidence.store import EvidenceStore, StoredEvidence
from rosrv_fleet.segment_store import DamagedFileError


def test_a_damaged_description_hides_no_other_bundle(tmp_path: Path) -> None:
    store = EvidenceStore(tmp_path / "evidence")
    for letter in "ab":
        about = StoredEvidence(
            log="0" * 32, since=0, until=1, recording="", records=1, checkpoints=1, collected=1, unproven=[],
            id=letter * 64, robot="arm1", bytes=1, added=1, by="tester",
        )  # fmt: skip
        folder = tmp_path / "evidence" / about.id
        folder.mkdir()
        (folder / "about.json").write_bytes(msgspec.json.encode(about))
    damaged = tmp_path / "evidence" / ("b" * 64) / "about.json"
    whole = damaged.read_bytes()
    damaged.write_bytes(b"damaged")
    assert [one.id for one in store.all()] == ["a" * 64]
    with pytest.raises(DamagedFileError, match=str(damaged)):
        store.get("b" * 64)
    damaged.write_bytes(whole)
    assert {one.id for one in store.all()} == {"a" * 64, "b" * 64}
