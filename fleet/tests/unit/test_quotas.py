from pathlib import Path

import pytest
from rosrv_fleet.config import Limits
from rosrv_fleet.quotas import OverQuotaError, RobotQuotas

from appliance.base.clock import wall
from tests.support.virtual_clock import let_time_pass, set_wall

_DAY = 86_400.0


def quotas(folder: Path) -> RobotQuotas:
    limits = Limits(robot_bytes_per_day=1_000_000, robot_unpacked_bytes_per_day=4_000_000)
    return RobotQuotas(folder, limits)


@pytest.mark.parametrize("used", [(1_000_000, 0), (0, 4_000_000)])
def test_used_bytes_survive_a_restart_and_return_evenly(used: tuple[int, int], tmp_path: Path) -> None:
    found = quotas(tmp_path)
    found.check("arm1")
    found.charge("arm1", 2 * used[0], 2 * used[1])
    let_time_pass(_DAY / 2)
    for again in (found, quotas(tmp_path)):
        with pytest.raises(OverQuotaError) as error:
            again.check("arm1")
        assert error.value.seconds == pytest.approx(_DAY / 2)
        again.check("arm2")
    let_time_pass(_DAY / 2 + 1)
    found.check("arm1")


def test_used_bytes_return_evenly_after_a_corrected_clock(tmp_path: Path) -> None:
    set_wall(wall() + 365 * _DAY)
    quotas(tmp_path).charge("arm1", 2_000_000, 0)
    set_wall(wall() - 365 * _DAY)
    found = quotas(tmp_path)
    for _ in range(2):
        with pytest.raises(OverQuotaError) as error:
            found.check("arm1")
        assert error.value.seconds > 0
        let_time_pass(_DAY / 2 + 1)
    found.check("arm1")


def test_a_robot_that_was_off_sends_its_backlog_faster(tmp_path: Path) -> None:
    found = quotas(tmp_path)
    found.charge("arm1", 65_536, 65_536)
    let_time_pass(30 * _DAY)
    for _ in range(8):
        found.check("arm1")
        found.charge("arm1", 1_000_000, 0)
    with pytest.raises(OverQuotaError, match="continues in 0 min"):
        found.check("arm1")
    found.charge("arm2", 1_000_000, 0)
    with pytest.raises(OverQuotaError):
        found.check("arm2")


def test_a_tiny_segment_has_its_price(tmp_path: Path) -> None:
    """Otherwise a robot could store countless files with few bytes."""
    found = quotas(tmp_path)
    for _ in range(1_000_000 // 65_536 + 1):
        found.check("arm1")
        found.charge("arm1", 1, 1)
    with pytest.raises(OverQuotaError, match="robot_bytes_per_day"):
        found.check("arm1")


def test_a_robot_pauses_after_a_refusal_by_its_processor_time(tmp_path: Path) -> None:
    found = quotas(tmp_path)

    def pause() -> float:
        with pytest.raises(OverQuotaError, match="has to pause") as error:
            found.check("arm1")
        let_time_pass(error.value.seconds + 1e-6)  # rounded
        found.check("arm1")
        return error.value.seconds

    for processor_time, expected in ((0.0, 1.0), (0.0, 1.0), (30.0, 300.0), (0.01, 1.0)):
        found.refused("arm1", processor_time)
        assert pause() == pytest.approx(expected)
    found.check("arm2")


def test_a_damaged_file_begins_again(tmp_path: Path) -> None:
    (tmp_path / "arm1.json").write_bytes(b"")
    found = quotas(tmp_path)
    found.check("arm1")
    found.charge("arm1", 2_000_000, 0)
    with pytest.raises(OverQuotaError):
        found.check("arm1")
