from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from tests.unit.features.standby.witness.robot import BOTH


def test_the_lease_survives_on_the_disk(tmp_path: Path) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    assert not file.has_room()
    stats = []
    for record in (LeaseRecord(7, "a", ("a",), "x"), LeaseRecord(8, "b", BOTH, "x")):
        file.write(record)
        assert file.read() == record
        stats.append((tmp_path / "lease").stat())
    before, after = stats
    assert (after.st_ino, after.st_size, after.st_mode & 0o777) == (before.st_ino, before.st_size, 0o600)


@pytest.mark.parametrize(("end", "epoch"), [(0, 7), (100, 7), (4096, 8), (4196, 8), (8192, 8)])
def test_a_crash_leaves_the_old_lease_or_the_new_one(tmp_path: Path, end: int, epoch: int) -> None:
    path, made = tmp_path / "lease", []
    file = LeaseFile(str(path), BOTH)
    for number in (7, 8):
        file.write(LeaseRecord(number, "a" * (number == 8), BOTH, "x"))
        made.append(path.read_bytes())
    path.write_bytes(made[1][:end] + made[0][end:])
    assert file.read().epoch == epoch


def test_the_lease_of_an_earlier_version_is_read_and_gets_room(tmp_path: Path) -> None:
    file, record = LeaseFile(str(tmp_path / "lease"), BOTH), LeaseRecord(7, "a", BOTH, "x")
    file.write(record)
    (tmp_path / "lease").write_bytes((tmp_path / "lease").read_bytes()[:4096].rstrip())
    assert file.read() == record and not file.has_room()
    file.write(record._replace(epoch=8))
    assert file.read().epoch == 8 and file.has_room()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: b"",
        lambda text: text[:-1],
        lambda text: text.replace(b'"epoch": 7', b'"epoch": 8'),
        lambda text: b"\xff" + text,
    ],
)
def test_a_damaged_lease_is_refused(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    file.write(LeaseRecord(7, "a", BOTH, "x"))
    (tmp_path / "lease").write_bytes(damage((tmp_path / "lease").read_bytes()))
    with pytest.raises(WitnessError, match=r"lease cannot be used: .*begin --in-sync NAMES --epoch N"):
        file.read()


@pytest.mark.parametrize(
    "record",
    [
        LeaseRecord(-1, "a", BOTH, ""),
        LeaseRecord(1, "a", ("a", "c"), ""),
        LeaseRecord(1, "", (), ""),
        LeaseRecord(1, "b", ("a",), ""),
    ],
)
def test_a_lease_of_other_appliances_is_refused(tmp_path: Path, record: LeaseRecord) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    file.write(record)
    with pytest.raises(WitnessError):
        file.read()


def test_a_save_that_fails_keeps_the_lease() -> None:
    with pytest.raises(WitnessError, match="cannot be saved"):
        LeaseFile("/dev/full/lease", BOTH).write(LeaseRecord(1, "", BOTH, ""))
