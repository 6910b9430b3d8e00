"""A bundle that cannot be taken now says nothing against the bundle: it waits, and the collector hears the reason."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from appliance.control.errors import PolicyRefusedError
from tests.unit.features.fleet.bundle_robot import BEFORE, FLEET, OF_OPERATOR, OFFER, BundleRobot

pytestmark = pytest.mark.anyio
_CONFIRM_SECONDS = FLEET.bundles.confirm_seconds


async def polled(robot: BundleRobot, seconds: float, *, offered: bool = True) -> None:
    """Let a poll offer a bundle, or none, and time pass."""
    robot.poll(offered=offered)
    await asyncio.sleep(seconds)


@pytest.fixture
async def robot(tmp_path: Path) -> BundleRobot:
    return BundleRobot(tmp_path)


@pytest.fixture
async def ordered(tmp_path: Path) -> BundleRobot:
    """Return a robot whose bundles wait for an order."""
    return BundleRobot(tmp_path, replace(FLEET, bundles=replace(FLEET.bundles, wait_for_order=True)))


async def test_a_change_by_an_operator_during_commit_confirm_only_delays_the_bundle(
    robot: BundleRobot,
) -> None:
    async with robot.running():
        await polled(robot, 5)
        assert robot.state.trying == OFFER.path
        robot.policies.change("olga")
        await asyncio.sleep(5)
        assert (robot.policies.in_force.who, robot.policies.in_force.text) == ("olga", OF_OPERATOR)
        assert robot.monitors.in_force.text == BEFORE
        assert "an operator changed" in robot.state.trouble
        assert robot.stated[-1].refused is None
        await polled(robot, _CONFIRM_SECONDS + 5)
        assert robot.stated[-1].in_force == OFFER.path
        assert not robot.state.trouble
        assert robot.trail.events == ["bundle in force"]


async def test_a_change_that_a_rollback_waits_for_stays(robot: BundleRobot) -> None:
    async with robot.running():
        await polled(robot, 5)
        robot.monitors.change("olga")
        robot.policies.meanwhile = lambda: robot.policies.change("olga")
        await asyncio.sleep(_CONFIRM_SECONDS)
        assert robot.policies.in_force.text == robot.monitors.in_force.text == OF_OPERATOR


@pytest.mark.parametrize("waiting", ["monitors", "policies"])
@pytest.mark.parametrize("changed", ["monitors", "policies"])
async def test_a_change_while_a_part_is_prepared_only_delays_the_bundle(
    waiting: str, changed: str, robot: BundleRobot
) -> None:
    parts = {"monitors": robot.monitors, "policies": robot.policies}
    parts[waiting].meanwhile = lambda: parts[changed].change("olga")
    async with robot.running():
        await polled(robot, 5)
        assert parts.pop(changed).in_force.text == OF_OPERATOR
        assert [part.in_force.text for part in parts.values()] == [BEFORE]
        assert robot.stated[-1].refused is None
        assert "an operator changed" in robot.state.trouble
        await polled(robot, _CONFIRM_SECONDS + 5)
        assert robot.stated[-1].in_force == OFFER.path


@pytest.mark.parametrize("ends", ["change", "offer"])
async def test_a_bundle_waits_no_longer_than_its_reason(ends: str, robot: BundleRobot) -> None:
    async with robot.running():
        robot.policies.confirm_by = 100.0
        await polled(robot, 2)
        assert "waits for its confirmation" in robot.state.trouble
        assert robot.stated[-1].waits == robot.state.trouble
        if ends == "change":
            robot.policies.confirm_by = None
        else:
            robot.poll(offered=False)
        await asyncio.sleep(2)
        assert not robot.state.trouble
        assert not robot.stated[-1].waits


async def test_a_bundle_that_would_hold_moving_topics_tells_the_collector_so(robot: BundleRobot) -> None:
    async with robot.running():
        robot.monitors.would_hold = ["/cmd_vel"]
        await polled(robot, 2)
        assert "waits until no message passes for a minute: /cmd_vel" in robot.stated[-1].waits


async def test_a_bundle_waits_for_an_order_and_each_try_needs_one(ordered: BundleRobot) -> None:
    async with ordered.running():
        await polled(ordered, _CONFIRM_SECONDS)
        assert ordered.state.for_order == OFFER.path
        assert "waits for an order: rosrv fleet take" in ordered.stated[-1].waits
        assert not ordered.gate.order("site-a/arms/1.tar", "olga")
        assert ordered.gate.order(OFFER.path, "olga")
        await asyncio.sleep(5)
        assert ordered.state.trying == OFFER.path
        ordered.policies.change("olga")  # ends this try
        await asyncio.sleep(5)
        await polled(ordered, 5)
        assert (ordered.state.trying, ordered.state.for_order) == ("", OFFER.path)
        assert ordered.gate.order(OFFER.path, "olga")
        await asyncio.sleep(_CONFIRM_SECONDS + 5)
        assert ordered.state.in_force == OFFER.path
        assert ordered.trail.events == ["bundle ordered", "bundle ordered", "bundle in force"]
        assert not ordered.gate.order(OFFER.path, "olga")


async def test_a_bundle_that_is_withdrawn_waits_for_no_order(ordered: BundleRobot) -> None:
    async with ordered.running():
        await polled(ordered, 2)
        await polled(ordered, 2, offered=False)  # the collector withdraws it
        assert not ordered.state.for_order
        assert not ordered.gate.order(OFFER.path, "olga")


async def test_a_bundle_that_would_hold_moving_topics_does_not_wait_for_an_order_yet(
    ordered: BundleRobot,
) -> None:
    async with ordered.running():
        ordered.monitors.would_hold = ["/cmd_vel"]
        await polled(ordered, 2)
        assert not ordered.state.for_order
        assert "no message passes for a minute" in ordered.state.trouble


@pytest.mark.parametrize("again", [True, False], ids=["the same bundle", "another bundle"])
async def test_the_bundle_that_waits_can_be_ordered_while_a_poll_offers(
    again: bool, ordered: BundleRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check of a large bundle takes a long time, and each poll offers it again."""
    checked = asyncio.Event()

    async def check(*_content: object) -> None:
        await checked.wait()

    async with ordered.running():
        await polled(ordered, 2)
        assert ordered.state.for_order == OFFER.path
        monkeypatch.setattr(ordered.policies, "attempt", check)
        offer = OFFER if again else structs.replace(OFFER, path="site-a/arms/3.tar", sha256="3" * 64)
        ordered.poller.send(offer)
        await asyncio.sleep(2)
        assert ordered.state.for_order == (OFFER.path if again else "")
        assert ordered.gate.order(OFFER.path, "olga") is again
        assert not ordered.gate.order(OFFER.path, "olga")
        checked.set()
        await asyncio.sleep(_CONFIRM_SECONDS + 5)
        assert (ordered.state.in_force, ordered.state.for_order) == (
            (OFFER.path, "") if again else ("", offer.path)
        )
        assert ordered.trail.events == (["bundle ordered", "bundle in force"] if again else [])


async def refuse(*_content: object) -> None:
    raise PolicyRefusedError([])


@pytest.mark.parametrize("reason", ["unconfirmed", "refused", "held"])
async def test_a_bundle_that_may_no_longer_be_taken_waits_for_no_order(
    reason: str, ordered: BundleRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with ordered.running():
        await polled(ordered, 2)
        assert ordered.state.for_order == OFFER.path
        match reason:
            case "unconfirmed":
                ordered.policies.confirm_by = 100.0
            case "refused":
                monkeypatch.setattr(ordered.policies, "attempt", refuse)
            case _:
                ordered.monitors.would_hold = ["/cmd_vel"]
        await polled(ordered, 2)
        assert not ordered.state.for_order
        assert not ordered.gate.order(OFFER.path, "olga")


@pytest.mark.parametrize("reason", ["policies", "monitors", "held", "refused"])
async def test_an_order_is_tried_or_the_state_has_the_reason(
    reason: str, ordered: BundleRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a check after the order finds that topics would be held, or that the bundle is refused."""
    revisions = {"policies": ordered.policies, "monitors": ordered.monitors}.get(reason)
    async with ordered.running():
        await polled(ordered, 2)
        if revisions is not None:
            revisions.confirm_by = 100.0
        elif reason == "held":
            ordered.monitors.would_hold = ["/cmd_vel"]
        else:
            monkeypatch.setattr(ordered.policies, "attempt", refuse)
        assert ordered.gate.order(OFFER.path, "olga") is (revisions is None)
        await asyncio.sleep(2)
        assert (ordered.state.trying, ordered.state.for_order) == ("", "")
        if reason == "refused":
            assert ordered.state.refused == OFFER.path
            return
        if reason == "held":
            assert "waits until no message passes for a minute: /cmd_vel" in ordered.state.trouble
            assert "needs another order" in ordered.state.trouble
            ordered.monitors.would_hold = []
            await polled(ordered, 2)
        elif revisions is not None:
            assert ordered.stated[-1].waits == ordered.state.trouble
            assert "waits for its confirmation" in ordered.state.trouble
            revisions.confirm_by = None
        assert ordered.gate.order(OFFER.path, "olga")
        await asyncio.sleep(2)
        assert ordered.state.trying == OFFER.path
