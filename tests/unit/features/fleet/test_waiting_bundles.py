"""A bundle that cannot be taken now says nothing against the bundle: it waits, and the collector hears the reason."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.control.assembly.policies import RevisionChangedError
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered, BundlePollReported, BundleStated
from appliance.features.fleet.settings import Bundles, Fleet
from appliance.features.fleet.view import BundlesState
from appliance.formats.bundle_archive import BundleContents
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.switches import Switches
from tests.support.core import FakeTrail
from tests.support.memory_channel import memory_link

pytestmark = pytest.mark.anyio
_HEALTHY = RobotHealth(0, frozenset(), frozenset())
_OFFER = BundleOffered(
    "site-a/arms/2.tar", "sha", BundleContents("[Nodes]\n# of the bundle\n", "hosts: []\n")
)
_compiled = cache(compile_policy)
_BEFORE, _OF_OPERATOR = "[Nodes]\n# before\n", "[Nodes]\n# of an operator\n"
_FLEET = Fleet(
    collector="https://10.0.0.9:8444", ca=Path("ca"), certificate=Path("robot.pem"), key=Path("robot.key"),
    robot="arm7", bundles=Bundles(root=Path("root.json"), site="site-a", group="arms"),
)  # fmt: skip
_CONFIRM_SECONDS = _FLEET.bundles.confirm_seconds


class _Part:
    """The policy, or the specifications: revisions with their authors."""

    def __init__(self) -> None:
        self.texts = [("", _BEFORE)]
        self.confirm_by: float | None = None
        self.error: Exception | None = None
        self.held: list[str] = []
        self.rollout = SimpleNamespace(held=frozenset())
        self.checked = SimpleNamespace(monitors={}, sharing=[])
        self.switches = Switches()
        self.sources = ""

    @property
    def revision(self) -> int:
        return len(self.texts)

    @property
    def in_force(self) -> SimpleNamespace:
        return SimpleNamespace(who=self.texts[-1][0], signature="")

    @property
    def current(self) -> Policy:
        return _compiled(self.texts[-1][1], file="policy.ini")

    def change(self, who: str, text: str = _OF_OPERATOR) -> None:
        self.texts.append((who, text))

    async def attempt(self, *_given: object) -> None:
        """All policies pass."""

    async def held_by_bundle(self, _sources: object) -> list[str]:
        return self.held

    async def load_with(self, load: Any, who: str, _cases: object) -> None:
        if self.error is not None:
            raise self.error
        self.change(who, load.text)

    async def take_bundle(self, _sources: object, who: str, _note: str) -> None:
        self.change(who, "of the bundle")

    async def roll_back(self, request: Any, who: str) -> None:
        self.change(who, self.texts[request.revision - 1][1])


class _Robot:
    def __init__(self, fleet: Fleet = _FLEET) -> None:
        self.policies, self.monitors = _Part(), _Part()
        self.hosts = SimpleNamespace(bundled="", take_bundle=self._take_hosts)
        self.trail = FakeTrail()
        self.stated: list[BundleStated] = []

        async def settled() -> None:
            """All is on the disk."""

        parts: Any = {
            "policies": self.policies, "monitors": self.monitors, "hosts": lambda: self.hosts,
            "store": SimpleNamespace(settings=dict, save_setting=lambda *_given: None, settled=settled),
            "trail": self.trail,
            "health": lambda _deprived: _HEALTHY,
        }  # fmt: skip
        self.gate = BundleGate(fleet, **parts)
        near, self.poller = memory_link(BundleLink)
        self.gate.link.attach(near)

    async def _take_hosts(self, text: str, _who: str) -> None:
        self.hosts.bundled = text

    def poll(self, *, offered: bool) -> None:
        """Send what a poll sends."""
        if offered:
            self.poller.send(_OFFER)
        self.poller.send(BundlePollReported(1.0, offered=offered))

    @property
    def trouble(self) -> str:
        return self.state.trouble

    @property
    def state(self) -> BundlesState:
        state = self.gate.status()
        assert state is not None
        return state

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        self.poller.attach(
            asyncio.get_running_loop(), lambda stated, _given: self.stated.append(stated), lambda: None
        )
        running = asyncio.create_task(self.gate.run())
        yield
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


@pytest.fixture
async def robot() -> _Robot:
    return _Robot()


async def test_a_change_by_an_operator_during_commit_confirm_only_delays_the_bundle(robot: _Robot) -> None:
    async with robot.running():
        robot.poll(offered=True)
        await asyncio.sleep(5)
        assert robot.state.trying == _OFFER.path
        robot.policies.change("olga")
        await asyncio.sleep(5)
        assert robot.policies.texts[-1] == ("olga", _OF_OPERATOR)
        assert robot.monitors.texts[-1][1] == _BEFORE
        assert "an operator changed" in robot.trouble
        assert robot.stated[-1].refused is None
        robot.poll(offered=True)
        await asyncio.sleep(_CONFIRM_SECONDS + 5)
        assert robot.stated[-1].in_force == _OFFER.path
        assert not robot.trouble
        assert robot.trail.events == ["bundle in force"]


async def test_a_change_while_the_policy_is_prepared_only_delays_the_bundle(robot: _Robot) -> None:
    async with robot.running():
        robot.policies.error = RevisionChangedError(1, 2)
        robot.poll(offered=True)
        await asyncio.sleep(5)
        assert robot.stated[-1].refused is None
        assert "revision 2 is in force, not 1" in robot.trouble
        robot.policies.error = None
        robot.poll(offered=True)
        await asyncio.sleep(_CONFIRM_SECONDS + 5)
        assert robot.stated[-1].in_force == _OFFER.path


@pytest.mark.parametrize("ends", ["change", "offer"])
async def test_a_bundle_waits_no_longer_than_its_reason(ends: str, robot: _Robot) -> None:
    async with robot.running():
        robot.policies.confirm_by = 100.0
        robot.poll(offered=True)
        await asyncio.sleep(2)
        assert "waits for its confirmation" in robot.trouble
        assert robot.stated[-1].waits == robot.trouble
        if ends == "change":
            robot.policies.confirm_by = None
        else:
            robot.poll(offered=False)
        await asyncio.sleep(2)
        assert not robot.trouble
        assert not robot.stated[-1].waits


async def test_a_bundle_that_would_hold_moving_topics_tells_the_collector_so(robot: _Robot) -> None:
    async with robot.running():
        robot.monitors.held = ["/cmd_vel"]
        robot.poll(offered=True)
        await asyncio.sleep(2)
        assert "waits until no message passes for a minute: /cmd_vel" in robot.stated[-1].waits


async def test_a_bundle_waits_for_an_order_and_each_try_needs_one() -> None:
    robot = _Robot(replace(_FLEET, bundles=replace(_FLEET.bundles, wait_for_order=True)))
    async with robot.running():
        robot.poll(offered=True)
        await asyncio.sleep(_CONFIRM_SECONDS)
        assert robot.state.for_order == _OFFER.path
        assert "waits for an order: rosrv fleet take" in robot.stated[-1].waits
        assert not robot.gate.order("site-a/arms/1.tar", "olga")
        assert robot.gate.order(_OFFER.path, "olga")
        await asyncio.sleep(5)
        assert robot.state.trying == _OFFER.path
        robot.policies.change("olga")  # ends this try
        await asyncio.sleep(5)
        robot.poll(offered=True)
        await asyncio.sleep(5)
        assert (robot.state.trying, robot.state.for_order) == ("", _OFFER.path)
        assert robot.gate.order(_OFFER.path, "olga")
        await asyncio.sleep(_CONFIRM_SECONDS + 5)
        assert robot.state.in_force == _OFFER.path
        assert robot.trail.events == ["bundle ordered", "bundle ordered", "bundle in force"]
        assert not robot.gate.order(_OFFER.path, "olga")


async def test_a_bundle_that_is_withdrawn_waits_for_no_order() -> None:
    robot = _Robot(replace(_FLEET, bundles=replace(_FLEET.bundles, wait_for_order=True)))
    async with robot.running():
        robot.poll(offered=True)
        await asyncio.sleep(2)
        robot.poll(offered=False)  # the collector withdraws it
        await asyncio.sleep(2)
        assert not robot.state.for_order
        assert not robot.gate.order(_OFFER.path, "olga")


async def test_a_bundle_that_would_hold_moving_topics_does_not_wait_for_an_order_yet() -> None:
    robot = _Robot(replace(_FLEET, bundles=replace(_FLEET.bundles, wait_for_order=True)))
    async with robot.running():
        robot.monitors.held = ["/cmd_vel"]
        robot.poll(offered=True)
        await asyncio.sleep(2)
        assert not robot.state.for_order
        assert "no message passes for a minute" in robot.trouble
