"""The order to switch over, from the operator to the process `lease`, in virtual time."""

import asyncio
import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.base import clock
from appliance.base.withdrawal import WithdrawnError, withdrawable
from appliance.features.standby import lease_link, replication
from appliance.features.standby.lease_client import HandOverError, LeaseClient
from appliance.features.standby.orders import ActiveAppliance
from appliance.features.standby.replication import Replication
from appliance.features.standby.replication_sender import ReplicationLag
from appliance.features.standby.summary import CHECKING, UNCHECKED
from tests.unit.features.standby.parts import MEMBERSHIP, CountedDatabase

pytestmark = pytest.mark.anyio

REFUSED_SECONDS = 2.0
CHECKED_SECONDS = 2.0
PAUSE_SECONDS = 2.0


class Active:
    """The active appliance `a`, whose standby stores a change `delay` seconds after it was written."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(replication, "replication_context", lambda *_, **__: None)
        self.did: list[tuple[str, float]] = []
        self.delay, self.connected, self.obstacle = 0.1, True, ""
        self.written = 0.0
        self.lease = LeaseClient()
        client, database = self.lease, CountedDatabase(7)
        parts: Any = client
        parts.send = self._ordered
        parts = self.replication = Replication(
            MEMBERSHIP, client, database, 4, taken_over=False, folder=Path()
        )  # fmt: skip
        parts.sender.lag = self._lag
        self.database = database
        self.report()
        self.order = ActiveAppliance(
            self.replication, self.rehearse, self._leave, lambda: self._do("pass again")
        )

    def report(self, **changes: Any) -> None:
        now = clock.since_boot()
        state = lease_link.LeaseState(
            until=math.inf, epoch=4, alone=False, permission=0, in_sync=True, holder="a", refusal="", answered=now,
            heard=now, other_witnessed=now + 0.1, takeover_obstacle="", trouble="",
        )  # fmt: skip
        self.lease.heard(msgspec.structs.replace(state, **changes))

    def _lag(self) -> ReplicationLag:
        stored = clock.now() - self.written >= self.delay
        return ReplicationLag(self.connected, 0 if stored else 1, 100, None, "", self.obstacle)

    def _do(self, what: str) -> None:
        self.did.append((what, clock.now()))

    async def rehearse(self) -> None:
        self._do("rehearse")
        self.written = clock.now()

    async def _leave(self) -> None:
        self._do("pause")
        self.written = clock.now()

    def _ordered(self, message: Any) -> None:
        if isinstance(message, lease_link.HandOverWanted):
            self._do("give up")
            asyncio.get_running_loop().call_soon(self.lease.heard, lease_link.HandOverAnswered(""))

    async def refused(self, seconds: float = REFUSED_SECONDS) -> str:
        began = clock.now()
        with pytest.raises(HandOverError) as caught:
            await self.order.hand_over()
        assert clock.now() - began <= seconds
        return str(caught.value)

    def steps(self) -> list[str]:
        return [what for what, _at in self.did]


@pytest.fixture
async def active(monkeypatch: pytest.MonkeyPatch) -> Active:
    return Active(monkeypatch)


async def test_the_standby_stores_as_much_as_the_switchover_before_anything_is_paused(active: Active) -> None:
    await active.order.hand_over()
    assert active.steps() == ["rehearse", "pause", "give up"]
    (_, paused), (_, given_up) = active.did[1:]
    assert given_up - paused <= active.delay + 0.02


async def test_a_slow_link_refuses_the_order_before_anything_is_paused(active: Active) -> None:
    """8 MB at 20 Mbit/s need 3.2 s. The standby stays in sync, because no answer waits for these bytes."""
    active.delay = 3.2
    assert await active.refused() == (
        "b has not stored the last changes after 1.2 s, so topics would pause for longer; check the network between"
        " both, and the disk of b"
    )
    assert active.steps() == ["rehearse"]
    assert active.replication.sender.alone is False


async def test_an_order_whose_client_left_during_the_check_pauses_nothing(active: Active) -> None:
    with withdrawable(lambda: True), pytest.raises(WithdrawnError):
        await active.order.hand_over()
    assert active.steps() == ["rehearse"]


async def test_a_silent_witness_refuses_the_order_before_anything_is_paused(active: Active) -> None:
    active.report(other_witnessed=clock.since_boot() - 0.1)
    assert "the witness on the robot does not answer b" in await active.refused()
    assert active.steps() == ["rehearse"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"in_sync": False}, "the standby b has been catching up for 0 s"),
        ({"heard": -10.0}, "the standby b (10.0.0.3) has been away"),
        ({"trouble": "the disk is full"}, "could not carry out a takeover: the disk is full"),
        ({"refusal": "the witness knows only epoch 3"}, "refuses this appliance"),
        ({"takeover_obstacle": "b could not serve after a takeover"}, "b could not serve after a takeover"),
    ],
)
async def test_a_reason_that_status_reports_refuses_the_order_at_once(
    active: Active, changes: dict[str, Any], reason: str
) -> None:
    active.report(**changes)
    began = clock.now()
    assert reason in await active.refused()
    assert reason in active.replication.state().troubles[0]
    assert (active.steps(), clock.now()) == ([], began)


async def test_a_check_that_fails_refuses_the_order_at_once(active: Active) -> None:
    active.obstacle = "other keys"
    assert "the standby b (10.0.0.3) cannot take over: other keys" in await active.refused()
    assert active.steps() == []


async def test_the_order_waits_until_the_standby_has_checked_a_change(active: Active) -> None:
    """The process `lease` says a moment later that the standby may have the lease."""
    active.obstacle = UNCHECKED
    active.report(takeover_obstacle="b could not serve after a takeover")

    def checked() -> None:
        active.obstacle = ""
        asyncio.get_running_loop().call_later(0.3, active.report)

    asyncio.get_running_loop().call_later(1.0, checked)
    await active.order.hand_over()
    assert active.steps() == ["rehearse", "pause", "give up"]


@pytest.mark.parametrize(
    ("obstacle", "text"),
    [(UNCHECKED, f"the standby b (10.0.0.3) cannot take over: {UNCHECKED}"), (CHECKING, CHECKING)],
)
@pytest.mark.parametrize("after", [0.0, 0.05])
async def test_a_change_that_the_standby_still_checks_refuses_the_order(
    active: Active, after: float, obstacle: str, text: str
) -> None:
    asyncio.get_running_loop().call_later(after, setattr, active, "obstacle", obstacle)
    asyncio.get_running_loop().call_later(CHECKED_SECONDS, active.report)  # the witness goes on answering
    assert text in await active.refused(CHECKED_SECONDS + 0.5)
    assert active.steps() == ["rehearse"]


async def test_a_standby_that_is_removed_after_the_order_refuses_it(active: Active) -> None:
    active.delay = 0.5
    asyncio.get_running_loop().call_later(0.3, lambda: active.report(in_sync=False))
    assert "the standby b has been catching up" in await active.refused()
    assert active.steps() == ["rehearse"]


@pytest.mark.parametrize(
    ("what", "value", "reason"),
    [("delay", math.inf, "b has not stored the last changes after 1 s"), ("obstacle", UNCHECKED, UNCHECKED)],
)
async def test_topics_pass_again_if_the_standby_becomes_slow_during_the_pause(
    active: Active, what: str, value: object, reason: str
) -> None:
    async def leave() -> None:
        active.did.append(("pause", clock.now()))
        active.written = clock.now()
        setattr(active, what, value)

    active.order = ActiveAppliance(
        active.replication, active.rehearse, leave, lambda: active.did.append(("pass again", clock.now()))
    )
    with pytest.raises(HandOverError, match=reason):
        await active.order.hand_over()
    assert active.steps() == ["rehearse", "pause", "pass again"]
    (_, paused), (_, again) = active.did[1:]
    assert again - paused <= PAUSE_SECONDS
