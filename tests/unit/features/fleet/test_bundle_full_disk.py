import asyncio
from pathlib import Path

import msgspec
import pytest

from appliance.features.fleet.bundle_gate import BundleRecord
from appliance.store.writer_thread import StoreError
from tests.unit.features.fleet.bundle_robot import OF_OPERATOR, OFFER, BundleRobot

pytestmark = pytest.mark.anyio
_FULL = "the state cannot be written: No space left on device"


@pytest.mark.parametrize("wait", [1, 2], ids=["before the trial", "after the trial"])
async def test_a_bundle_that_a_full_disk_rolled_back_is_not_in_force_and_is_tried_again(
    wait: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = BundleRobot(tmp_path)
    save, settled = robot.store.save_setting, robot.store.until_settled
    is_trial: list[bool] = []
    waits = iter([StoreError(_FULL) if wait == number else None for number in (1, 2)])

    def noted(name: str, value: str) -> None:
        is_trial.append(msgspec.json.decode(value, type=BundleRecord).trial is not None)
        save(name, value)

    async def full_once() -> None:
        if (error := next(waits, None)) is not None:
            raise error
        await settled()

    monkeypatch.setattr(robot.store, "save_setting", noted)
    monkeypatch.setattr(robot.store, "until_settled", full_once)
    robot.policies.change("olga")
    robot.monitors.change("olga")
    async with robot.running():
        robot.poll(offered=True)
        await asyncio.sleep(60)
        assert (robot.state.in_force, robot.state.trying, robot.state.trouble) == ("", "", _FULL)
        assert [part.in_force.text for part in (robot.policies, robot.monitors)] == [OF_OPERATOR] * 2
        assert robot.hosts.bundled == ""
        assert is_trial[-2:] == [True, False], "after a crash in between, the next start rolls back"
        robot.poll(offered=True)
        await asyncio.sleep(60)
        assert (robot.state.in_force, robot.state.trying, robot.state.trouble) == (OFFER.path, "", "")
        assert robot.trail.events == ["bundle in force"]
