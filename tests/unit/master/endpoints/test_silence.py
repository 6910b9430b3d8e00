"""Only a silence that a relay heard ends a right: a holder that publishes keeps its group, and its approval."""

import random
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from appliance.base import clock
from appliance.features.approvals.requests import ApproveCall
from appliance.features.authority.requests import DriveTake
from appliance.master.endpoints.host_signs import HostSigns, host_signs
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.policy_compiler import compile_policy
from tests.support.core import FakeTrail
from tests.support.ends import ends_in
from tests.support.incarnations import incarnation
from tests.support.virtual_clock import VirtualClock
from tests.unit.features.approvals import test_approval_orders as approvals
from tests.unit.features.authority import test_drive_orders as drive
from tests.unit.relay.connections.test_relayed_topic import HEADER, RecordedUpstream, Story, batch

pytestmark = pytest.mark.anyio
STEP, UNHEARD = 0.25, 20.0


class Wire(RecordedUpstream):
    """The connection to a publisher that answers at once."""

    def __init__(self, story: Story) -> None:
        super().__init__()
        self._story, self.is_open = story, False

    def connect(self) -> None:
        if not self.is_open:
            self.is_open = True
            self._story.topic.upstream_opened(HEADER)

    def release(self) -> None:
        if self.is_open:
            self.is_open = False
            self._story.topic.upstream_closed()


class Robot:
    """A publisher of /cmd_vel, its relay, and what control knows from the relay's reports."""

    def __init__(self, time: VirtualClock, host: str) -> None:
        self.time, self.registry = time, Registry()
        self.carried = RelayTraffic(FakeTrail(), self.registry, 1, lambda *_cut: None)
        self.signs: HostSigns = host_signs(self.registry, self.carried)
        self.node = incarnation("/pad", key="k", host=host)
        self.registry.add(self.node)
        self.registry.register(self.node, Kind.PUBLICATION, "/cmd_vel", "geometry_msgs/Twist")
        self.publishes = True
        self.check: Callable[[], Awaitable[None]]
        self._steps = 0
        self.begin_relay()

    def begin_relay(self) -> None:
        self.story = Story("/cmd_vel", fresh=False)
        self.story.now = clock.now()
        self.wire = self.story.topic.upstream = Wire(self.story)
        self.story.topic.keep_open(kept=True)
        self.base = self.story.join()

    def report(self) -> None:
        self.story.now = clock.now()
        if (row := self.story.topic.traffic()) is not None:
            self.carried.reported([row], 1.0)

    async def pass_time(self, seconds: float, *, relay: bool = True) -> None:
        for _ in range(round(seconds / STEP)):
            self.time.advance(STEP)
            self._steps += 1
            if relay:
                self.story.now = clock.now()
                if self.publishes and self.wire.is_open:
                    self.story.receive(batch(b"go"))
                if self._steps % 4 == 0:
                    self.report()
            await self.check()


async def hang(robot: Robot) -> None:
    await robot.pass_time(6.75, relay=False)
    robot.report()  # before it reads what waited


async def crash(robot: Robot) -> None:
    robot.carried.lost(0)
    await robot.pass_time(3.5, relay=False)
    robot.begin_relay()


async def move(robot: Robot) -> None:
    robot.report()
    await robot.pass_time(2.5, relay=False)
    robot.begin_relay()


async def lose_the_subscriber(robot: Robot) -> None:
    robot.story.topic.leave(robot.base)
    await robot.pass_time(30)


class Right(NamedTuple):
    robot: Robot
    holds: Callable[[], bool]


async def of_group(time: VirtualClock, lease: str, _path: Path) -> Right:
    robot = Robot(time, drive.PILOT)
    site = drive.Site(random.Random(1), time, robot.signs)  # noqa: S311  a repeatable history
    site.live = {robot.node.host}
    site.policy = compile_policy(drive.TEXT.replace("5s", lease), file="site.ini")
    robot.check = site.orders.check
    await site.orders.take(DriveTake("base", drive.PILOT), "op")
    return Right(robot, lambda: site.orders.holders() == {"base": robot.node.host})


async def of_approval(time: VirtualClock, lease: str, path: Path) -> Right:
    robot = Robot(time, str(approvals.AGENT))
    site = approvals.Site(time, ends_in(path), robot.signs)
    site.text = compile_policy(approvals.TEXT.replace("5s", lease), file="site.ini")
    site.decide_again()
    robot.check = site.orders.check
    await site.orders.approve(ApproveCall(approvals.number_in(site.publish("/cmd_vel")), 3600.0), "ann")
    return Right(robot, lambda: bool(site.orders.approved()))


@pytest.mark.parametrize("right", [of_group, of_approval])
@pytest.mark.parametrize("lease", [2.0, 5.0])
class TestARight:
    @pytest.mark.parametrize("cause", [hang, crash, move, lose_the_subscriber])
    @pytest.mark.parametrize("before", [0.0, 5.5])
    async def test_outlives_each_cause_of_missing_reports(
        self,
        tmp_path: Path,
        right: Callable[[VirtualClock, str, Path], Awaitable[Right]],
        lease: float,
        cause: Callable[[Robot], Awaitable[None]],
        before: float,
    ) -> None:
        with clock.using(time := VirtualClock()):
            robot, holds = await right(time, f"{lease:g}s", tmp_path)
            await robot.pass_time(before)
            for _ in range(2):
                await cause(robot)
                await robot.pass_time(2)
                assert holds()

    @pytest.mark.parametrize("cause", ["silent", "node ended", "relay away"])
    async def test_ends_by_a_silence_in_time(
        self,
        tmp_path: Path,
        right: Callable[[VirtualClock, str, Path], Awaitable[Right]],
        lease: float,
        cause: str,
    ) -> None:
        with clock.using(time := VirtualClock()):
            robot, holds = await right(time, f"{lease:g}s", tmp_path)
            await robot.pass_time(5.5)
            robot.publishes = False
            if cause == "node ended":
                robot.registry.unregister(robot.node, Kind.PUBLICATION, "/cmd_vel")
                robot.carried.forgotten(robot.node.key)
            most = lease + (UNHEARD if cause == "relay away" else 0)
            await robot.pass_time(most - 1, relay=cause != "relay away")
            assert holds()
            await robot.pass_time(2.25, relay=cause != "relay away")
            assert not holds()
