"""A bundle that changes nothing is in force in the end, however short a time the appliance has run."""

import asyncio
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.telemetry.audit_trail import LastMinute
from tests.unit.features.fleet.bundle_robot import OFFER, BundleRobot

pytestmark = pytest.mark.anyio
_POLL_SECONDS = 70


async def _after_polls(robot: BundleRobot, wait: float, a_minute: float, fails_after: float) -> None:
    """Offer the bundle three times, to a robot with these denials a minute and a monitor that fails after its start."""
    meter, began = LastMinute(), clock.now()

    async def deny() -> None:
        while a_minute:
            meter.add("192.168.1.10")
            await asyncio.sleep(60 / a_minute)

    def health(_deprived: object) -> RobotHealth:
        failing = frozenset(["battery"] if clock.now() - began > fails_after else [])
        return RobotHealth(sum(meter.counts().values()), failing, frozenset())

    robot.gate._measured = health
    denying = asyncio.create_task(deny())
    async with robot.running():
        await asyncio.sleep(wait)
        for _poll in range(3):
            robot.poll(offered=True)
            await asyncio.sleep(_POLL_SECONDS)
    denying.cancel()


@pytest.mark.parametrize("wait", [0, 2, 5, 29, 59, 61, 120])
@pytest.mark.parametrize("fails_after", [20.0, 1e9])
@pytest.mark.parametrize("a_minute", [0, 5, 12, 20, 60, 600])
async def test_unchanged_health_refuses_no_bundle(
    a_minute: float, fails_after: float, wait: float, tmp_path: Path
) -> None:
    robot = BundleRobot(tmp_path)
    await _after_polls(robot, wait, a_minute, fails_after)
    assert (robot.state.in_force, robot.state.refused) == (OFFER.path, "")


@pytest.mark.parametrize("wait", [0, 59, 61, 120])
async def test_a_bundle_that_makes_a_monitor_fail_is_refused_in_the_end(wait: float, tmp_path: Path) -> None:
    robot = BundleRobot(tmp_path)
    robot.gate._measured = lambda _deprived: RobotHealth(
        0,
        frozenset(["battery"] if robot.policies.in_force.text == OFFER.contents.policy else []),
        frozenset(),
    )
    async with robot.running():
        await asyncio.sleep(wait)
        for _poll in range(3):
            robot.poll(offered=True)
            await asyncio.sleep(_POLL_SECONDS)
    assert (robot.state.in_force, robot.state.refused) == ("", OFFER.path)
