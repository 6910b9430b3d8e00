"""One judgement of a pair: what it finds is reported by status, REST, console and metrics, and refuses a switchover."""

from typing import Any

import pytest
from rich.console import Console

from appliance.channel.alarms import open_alarms
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.live_verbs import standby_view
from appliance.features.standby.summary import CHECKING, UNCHECKED, standby_troubles, takeover_obstacles
from appliance.features.standby.view import samples_of
from tests.support.answers import example
from tests.unit.channel.test_alarms import changed

ACTIVE: dict[str, Any] = {
    "name": "a",
    "address": "10.0.0.1",
    "role": "active",
    "other": {"name": "b", "address": "10.0.0.2", "connected": True, "in_sync": True},
    "witness": {"address": "10.0.0.10", "answered_seconds": 0.2, "holder": "a"},
}
STANDBY: dict[str, Any] = ACTIVE | {
    "name": "b",
    "address": "10.0.0.2",
    "role": "standby",
    "other": {"name": "a", "address": "10.0.0.1", "connected": True, "in_sync": True},
}
BOTH = (ACTIVE, STANDBY)
SMALLER = "the witness knows only epoch 3: run witness.py begin with a greater epoch"


def state(of: dict[str, Any], more: dict[str, Any]) -> StandbyState:
    return example(StandbyState, **{name: _with(of.get(name), value) for name, value in (of | more).items()})


def shown(screen: Any) -> str:
    console = Console(width=400)
    with console.capture() as made:
        console.print(screen)
    return made.get()


def _with(given: Any, value: Any) -> Any:
    return given | value if isinstance(value, dict) else value


@pytest.mark.parametrize("of", BOTH)
def test_a_whole_pair_has_no_trouble(of: dict[str, Any]) -> None:
    assert [*standby_troubles(state(of, {}))] == []
    assert takeover_obstacles(state(of, {}), "b could not serve") == ["b could not serve"]


TROUBLES: list[tuple[tuple[dict[str, Any], ...], dict[str, Any], str]] = [
    ((ACTIVE,), {"other": {"connected": False, "reason": "the connection was reset"}},
     "the standby b (10.0.0.2) has been away for 0 s: the connection was reset; check that it runs, and the network"
     " between the two"),
    ((ACTIVE,), {"other": {"in_sync": False, "behind_changes": 12, "behind_bytes": 3400, "trouble_seconds": 90}},
     "the standby b has been 12 changes (3400 bytes) behind for 1 min, so it cannot take over; check the disk and the"
     " load of its machine"),
    ((STANDBY,), {"other": {"in_sync": False}},
     "the standby b (10.0.0.2) lacks changes of a, so it cannot take over; check the disk and the load of its machine"),
    (BOTH, {"obstacle": "policy.ini:1:1: error: it has no signature of the site"},
     "the standby b (10.0.0.2) cannot take over: policy.ini:1:1: error: it has no signature of the site; once this is"
     " corrected, b notices it within seconds"),
    (BOTH, {"obstacle": UNCHECKED}, f"the standby b (10.0.0.2) cannot take over: {UNCHECKED}"),
    (BOTH, {"witness": {"refusal": SMALLER}, "other": {"in_sync": False}},
     f"the witness on the robot (10.0.0.10) refuses this appliance, so no takeover is possible: {SMALLER}"),
    ((ACTIVE,), {"other": {"witness_seconds": 16.2}},
     "the witness on the robot (10.0.0.10) has not answered the standby b (10.0.0.2) for 16 s, so the standby cannot"
     " take over; check the network between both"),
    ((ACTIVE,), {"witness": {"trouble": "Read-only file system"}},
     "the witness on the robot (10.0.0.10) could not carry out a takeover: Read-only file system; correct that on the"
     " robot"),
    (BOTH, {"other": {"connected": False, "refusal": "a change does not fit: the state has no table 'ends'"}},
     "the standby b (10.0.0.2) does not follow, because it refuses what the active appliance sends: a change does not"
     " fit: the state has no table 'ends'; if the version of b is older (rosrv --version), upgrade it: until then"
     " there is no standby"),
    ((ACTIVE,), {"other": {"connected": False, "refusal": "state.db: database or disk is full; free space there"}},
     "the standby b (10.0.0.2) does not follow, because it refuses what the active appliance sends: state.db:"
     " database or disk is full; free space there"),
    ((ACTIVE,), {"witness": {"holder": "b"}},
     "both appliances claim to be active: this one does, but the witness names b, and the robot admits only b; stop"
     " this appliance, then start it again"),
]  # fmt: skip
"""On which of the two, what differs from a whole pair, and the trouble."""


@pytest.mark.parametrize(
    ("of", "more", "text"), [(of, more, text) for sides, more, text in TROUBLES for of in sides]
)
def test_each_trouble_is_reported_everywhere(of: dict[str, Any], more: dict[str, Any], text: str) -> None:
    obstacles = takeover_obstacles(state(of, more), "as the process `lease` found sooner")
    assert obstacles == [text]
    reported = state(of, more | {"troubles": obstacles})
    assert standby_view(reported).exit_status == 1
    assert [*samples_of(reported)["rosrv_standby_can_take_over"]] == [((), False)]
    assert [*samples_of(state(of, {}))["rosrv_standby_can_take_over"]] == [((), True)]


@pytest.mark.parametrize("of", BOTH)
def test_an_active_appliance_that_does_not_serve_is_reported_on_both(of: dict[str, Any]) -> None:
    """It does not prevent a switchover, which may be the remedy."""
    reported = state(of, {"not_serving": "the disk is full; it keeps the lease: b could not serve"})
    assert takeover_obstacles(reported, "") == []
    view = standby_view(reported)
    text = "the active appliance a (10.0.0.1) does not serve the robot: the disk is full; it keeps the lease: b could"
    assert (view.exit_status, text in shown(view.screen)) == (1, True)
    alarms = open_alarms(changed("standby", of | {"not_serving": "the disk is full"}))
    assert [(alarm.kind, alarm.severity) for alarm in alarms] == [("not-serving", "alarm")]


def test_a_lease_of_another_time_is_not_taken_for_two_active_appliances() -> None:
    """The witness with a smaller epoch admits neither appliance, so its holder is not another active one."""
    (trouble,) = standby_troubles(state(ACTIVE, {"witness": {"refusal": SMALLER}}))
    assert trouble.kind == "witness-refuses"


@pytest.mark.parametrize("of", BOTH)
def test_a_standby_that_checks_a_change_could_take_over(of: dict[str, Any]) -> None:
    """It does so at once if the active appliance is away: only an order waits."""
    checking = state(of, {"obstacle": CHECKING, "other": {"trouble_seconds": 59.0}})
    assert takeover_obstacles(checking, "b could not serve after a takeover") == []
    view = standby_view(checking)
    assert (view.exit_status, CHECKING in shown(view.screen)) == (0, True)
    assert [*samples_of(checking)["rosrv_standby_can_take_over"]] == [((), True)]


@pytest.mark.parametrize("obstacle", [UNCHECKED, CHECKING])
@pytest.mark.parametrize(("seconds", "kinds"), [(59.0, []), (60.0, ["standby-unchecked"])])
def test_a_check_that_never_ends_becomes_an_alarm(obstacle: str, seconds: float, kinds: list[str]) -> None:
    more = {"obstacle": obstacle, "other": ACTIVE["other"] | {"trouble_seconds": seconds}}
    assert [alarm.kind for alarm in open_alarms(changed("standby", ACTIVE | more))] == kinds
