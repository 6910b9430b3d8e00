"""The state of monitors passes from one appliance to the other only if nothing can have changed it since."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.control.inheritance import inherited_state
from appliance.control.lease_client import LeaseClient
from appliance.control.replication import Pair
from appliance.control.standby_tunnels import StandbyTunnels
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase
from tests.support.standby_site import memberships


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
    """The appliances, one of which is active in each epoch."""

    def __init__(self, members: dict[str, Pair], store: StateStore) -> None:
        self.members, self.store = members, store
        self.epoch = 1

    def active(self, name: str, *, taken: bool = True) -> tuple[str, tuple[bytes, ...]]:
        """Make an appliance active; return why the state is lost, and what was left. `taken`: its relays have it."""
        self.epoch += 1
        state, settle = inherited_state(self.members[name]._replace(epoch=self.epoch), self.store)
        if taken:
            settle()
        return state.lost, state.left

    def hand_over(self, content: bytes) -> None:
        self.store.save_monitor_state(0, self.epoch, content)


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


def test_a_state_that_was_left_is_void_if_its_appliance_went_on(pairs: Pairs) -> None:
    pairs.active("a")
    pairs.hand_over(b"left by a")
    pairs.active("a")
    lost, left = pairs.active("b")
    assert lost
    assert left == ()


def test_an_epoch_in_between_makes_the_state_void(pairs: Pairs) -> None:
    """An appliance that was granted an epoch may have passed messages before it could store that."""
    pairs.active("a")
    pairs.hand_over(b"left by a")
    pairs.active("a", taken=False)
    lost, left = pairs.active("b")
    assert lost
    assert left == ()


def test_a_control_that_dies_before_its_relays_have_the_state_inherits_again(pairs: Pairs) -> None:
    """Otherwise its monitors would begin in their initial state."""
    pairs.active("a")
    pairs.active("b", taken=False)
    pairs.epoch -= 1
    assert "appliance a was active" in pairs.active("b")[0]
