"""Whether a rebooted appliance may take over, by the witness's answers and the other appliance's state."""

import asyncio
import socket
from collections.abc import Iterator

import pytest

from appliance.base import clock
from appliance.features.standby.lease import ApplianceLease, WitnessAnswer, WitnessRequest
from appliance.features.standby.lease_link import LeaseState
from appliance.features.standby.replica_sync import WAIT_SECONDS, StateComparison, is_recovered
from appliance.features.standby.replication_frames import FromActive, Refused, ReplicationLink, Stored
from tests.support.virtual_clock import VirtualClock, let_time_pass


class Rebooted:
    """Appliance b, and the answers of the witness."""

    def __init__(self) -> None:
        self.lease = ApplianceLease("b", "a", "session", 5, clock.since_boot())
        self.number = 0
        self.holder = "a"

    def ask(self, *, expired: bool, in_sync: str = "ab", epoch: int = 5) -> None:
        self.number += 1
        request = WitnessRequest("look", 5, self.number, clock.since_boot())
        self.lease.answered(
            request,
            WitnessAnswer(
                ok=True, reason="", epoch=epoch, holder=self.holder, in_sync=frozenset(in_sync),
                expired=expired,
            ),
        )  # fmt: skip

    def pass_time(self, seconds: float, *, expired: bool) -> None:
        for _ in range(round(seconds * 10)):
            let_time_pass(0.1)
            self.ask(expired=expired)

    def recovered(self, *, followed: bool = False, comparison: StateComparison | None = None) -> bool:
        lease = self.lease
        state = LeaseState(
            0.0, 5, False, 0, True, self.holder, "", None, None, None, "", "",
            sole=lease.sole, expired_since=lease.expired_since,
        )  # fmt: skip
        compared = comparison or StateComparison(lambda: Stored(0, "", 0))
        return is_recovered("b", state, compared, followed=followed)


@pytest.fixture
def rebooted() -> Iterator[Rebooted]:
    with clock.using(VirtualClock(now=100.0)):
        yield Rebooted()


def test_it_has_followed_the_active_appliance(rebooted: Rebooted) -> None:
    assert not rebooted.recovered()
    assert rebooted.recovered(followed=True)


def test_ten_seconds_count_only_while_no_appliance_holds_the_lease(rebooted: Rebooted) -> None:
    """While the active appliance serves, this one cannot reach it, and may lack a change that it acknowledged."""
    rebooted.pass_time(2 * WAIT_SECONDS, expired=False)
    assert not rebooted.recovered()
    rebooted.pass_time(WAIT_SECONDS - 1.0, expired=True)
    rebooted.pass_time(0.1, expired=False)
    rebooted.pass_time(WAIT_SECONDS - 0.2, expired=True)
    assert not rebooted.recovered()
    rebooted.pass_time(1.0, expired=True)
    assert rebooted.recovered()


def test_a_silence_of_the_witness_does_not_count(rebooted: Rebooted) -> None:
    """During it, another appliance may have been active."""
    rebooted.pass_time(1.0, expired=True)
    let_time_pass(WAIT_SECONDS)
    rebooted.ask(expired=True)
    assert not rebooted.recovered()


def test_an_appliance_that_alone_is_in_sync_need_not_wait(rebooted: Rebooted) -> None:
    rebooted.ask(expired=False, in_sync="b", epoch=4)  # of a witness whose disk was restored
    assert not rebooted.recovered()
    rebooted.ask(expired=False, in_sync="b")
    assert rebooted.recovered()


async def compared(own: Stored, other: Stored) -> StateComparison:
    """Return what an appliance knows after the other one, which follows it, has sent its position."""
    comparison = StateComparison(lambda: own)
    here, there = await asyncio.gather(*(asyncio.open_connection(sock=end) for end in socket.socketpair()))
    follower = ReplicationLink[FromActive](*there, FromActive)
    await follower.send(other)
    await comparison.serve(*here)
    assert await follower.receive(1.0) == Refused("this appliance is not active either")
    await follower.close()
    return comparison


@pytest.mark.parametrize(
    ("own", "other", "last", "may"),
    [(7, 5, "a", True), (5, 7, "b", False), (6, 6, "b", True), (6, 6, "a", False), (0, 0, "", True)],
)
@pytest.mark.anyio
@pytest.mark.usefixtures("local_sockets")
async def test_the_rebooted_appliance_with_more_changes_takes_over(
    rebooted: Rebooted, *, own: int, other: int, last: str, may: bool
) -> None:
    """With equal states it is the last holder of the lease, whose monitors need not hold their topics."""
    rebooted.holder = last
    comparison = await compared(Stored(3, "history", own), Stored(0, "history", other))
    assert rebooted.recovered(comparison=comparison) is may


@pytest.mark.parametrize("histories", [("one", "another"), ("", "")])
@pytest.mark.anyio
@pytest.mark.usefixtures("local_sockets")
async def test_states_of_different_histories_cannot_be_compared(
    rebooted: Rebooted, histories: tuple[str, str]
) -> None:
    rebooted.holder = "b"
    comparison = await compared(Stored(3, histories[0], 7), Stored(3, histories[1], 5))
    assert not rebooted.recovered(comparison=comparison)
