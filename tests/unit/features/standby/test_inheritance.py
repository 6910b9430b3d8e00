import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.messages import StateLeft
from appliance.features.standby.inheritance import (
    CopyAge,
    StateCopies,
    inherited_state,
    keep_state,
    leave_state,
)
from appliance.features.standby.lease_client import HandOverError, LeaseClient
from appliance.features.standby.replication import Pair
from appliance.features.standby.tunnels import StandbyTunnels
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase
from tests.support.features.standby.standby_site import memberships
from tests.support.virtual_clock import VirtualClock, let_time_pass


@pytest.fixture
def store(tmp_path: Path) -> Iterator[StateStore]:
    made = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    yield made
    made.close()


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Pair]]:
    made, *_settings = memberships(tmp_path_factory.mktemp("members"))
    yield {
        name: Pair(one, LeaseClient(), 0, None, taken_over=True, tunnels=StandbyTunnels())
        for name, one in made.items()
    }


class Pairs:
    def __init__(self, members: dict[str, Pair], store: StateStore) -> None:
        self.members, self.store = members, store
        self.epoch = 1
        self.copy_age: float | None = 1.0

    def active(self, name: str, *, taken: bool = True) -> tuple[str, tuple[bytes, ...]]:
        self.epoch += 1
        state, settle = inherited_state(
            self.members[name]._replace(epoch=self.epoch, copy_age=self.copy_age), self.store
        )
        if taken:
            settle()
        return state.lost, state.left

    def hand_over(self, content: bytes) -> None:
        asyncio.run(leave_state(self.present, self.store, Relays(content)))

    @property
    def present(self) -> Pair:
        return self.members["a"]._replace(epoch=self.epoch)

    def copied(self, followed: Callable[[], bool] = lambda: True) -> "tuple[Relays, StateCopies]":
        """Let `a` be active, and copy the state of two relays."""
        self.active("a")
        relays = Relays(b"of relay 0", b"of relay 1")
        copies = StateCopies(self.present, self.store, relays, followed)
        asyncio.run(copies.copy_once())
        return relays, copies


class Relays:
    """Relays that return these copies of the state. A relay whose copy is None does not answer."""

    def __init__(self, *contents: bytes | None) -> None:
        self.contents = contents
        self.state = True
        self.hangs = False
        self.at = 5
        self.fully: list[bool] = []

    def has_state(self) -> bool:
        return self.state

    async def leave(self, _seconds: float) -> list[bytes]:
        return [content or b"" for content in self.contents]

    async def copies(self, _seconds: float, *, full: bool) -> list[StateLeft]:
        self.fully.append(full)
        if self.hangs:
            raise TimeoutError
        if None in self.contents and full:
            raise ConnectionError
        return [StateLeft(0, content, self.at) for content in self.contents]

    def pass_again(self) -> None: ...


@pytest.fixture
def pairs(members: dict[str, Pair], store: StateStore) -> Pairs:
    return Pairs(members, store)


def test_the_first_active_appliance_keeps_its_own_state(pairs: Pairs) -> None:
    assert pairs.active("a") == ("", ())
    assert pairs.active("a") == ("", ())


def test_after_a_failure_the_state_is_lost(pairs: Pairs) -> None:
    pairs.active("a")
    lost, left = pairs.active("b")
    assert "appliance a was active" in lost
    assert left == ()
    lost, _ = pairs.active("a")
    assert "appliance b was active" in lost


def test_a_planned_switchover_passes_the_state_on_once(pairs: Pairs) -> None:
    pairs.active("a")
    pairs.hand_over(b"left by a")
    assert pairs.active("b") == ("", (b"left by a",))
    assert "appliance b was active" in pairs.active("a")[0]


@pytest.mark.parametrize("taken", [True, False])
def test_a_state_that_was_left_is_void_if_its_appliance_went_on(pairs: Pairs, taken: bool) -> None:
    pairs.active("a")
    pairs.hand_over(b"left by a")
    pairs.active("a", taken=taken)
    lost, left = pairs.active("b")
    assert lost
    assert left == ()


def test_a_failed_switchover_makes_the_state_void(pairs: Pairs) -> None:
    pairs.active("a")
    pairs.hand_over(b"left by a")
    keep_state(pairs.store, Relays())
    assert pairs.active("b")[1] == ()


def test_after_a_failure_a_fresh_copy_is_used(pairs: Pairs) -> None:
    pairs.copied()
    lost, left = pairs.active("b")
    assert "appliance b" not in lost and "appliance a was active" in lost
    assert left == (b"of relay 0", b"of relay 1")
    assert pairs.active("a")[1] == ()


@pytest.mark.parametrize("why", ["old", "none", "a relay is away", "no standby", "no state"])
def test_a_copy_that_is_not_up_to_date_is_not_used(pairs: Pairs, why: str) -> None:
    followed = [True]
    relays, copies = pairs.copied(lambda: followed[0])
    pairs.copy_age = {"old": 6.0, "none": None}.get(why, 1.0)
    relays.contents = (b"of relay 0", None)  # the second has not changed
    asyncio.run(copies.copy_once())
    followed[0] = why != "no standby"
    if why == "a relay is away":
        relays.hangs = True
    elif why == "no state":
        relays.at = 0
    asyncio.run(copies.copy_once())
    assert pairs.active("b")[1] == ()


def test_a_rehearsal_stores_as_much_as_the_switchover_while_messages_pass(pairs: Pairs) -> None:
    relays, copies = pairs.copied()
    relays.contents = (b"later", b"of relay 1")
    asyncio.run(copies.rehearse())
    assert relays.fully == [True, True]
    assert pairs.active("b")[1] == (b"later", b"of relay 1")


def test_a_rehearsal_that_fails_refuses_the_switchover_and_is_followed_by_a_whole_copy(pairs: Pairs) -> None:
    """A relay that did answer sends its last changes only once, so a copy of later changes would lack them."""
    relays, copies = pairs.copied()
    relays.hangs = True
    with pytest.raises(HandOverError, match="a relay does not answer"):
        asyncio.run(copies.rehearse())
    relays.hangs = False
    asyncio.run(copies.copy_once())
    asyncio.run(copies.copy_once())
    assert relays.fully == [True, True, True, False]
    relays.hangs = True
    with pytest.raises(HandOverError, match="a relay does not answer"):
        asyncio.run(copies.rehearse())
    assert pairs.active("b")[1] == ()


def test_the_age_of_copies_counts_from_a_new_note() -> None:
    with clock.using(VirtualClock(now=100.0)):
        age = CopyAge(lambda _name: "old")
        age.look("old")
        assert age.at(clock.now()) is None
        age.look("new")
        let_time_pass(3.0)
        age.look("new")
        assert age.at(clock.now()) == 3.0


def test_a_control_that_dies_before_its_relays_have_the_state_inherits_again(pairs: Pairs) -> None:
    pairs.active("a")
    pairs.active("b", taken=False)
    pairs.epoch -= 1
    assert "appliance a was active" in pairs.active("b")[0]
