"""Judge whether the standby could take over now. No I/O.

Commands, REST, the console and metrics report these troubles, alarms those that last, and the order to switch over is
refused with the first.
"""

from collections.abc import Iterator

from appliance.base.counted import counted
from appliance.features.standby.answers import OtherAppliance, StandbyState, WitnessSeen
from appliance.features.view import Trouble

PATIENCE_SECONDS = 60.0
"""The time that the standby may be away or behind before an alarm: an update of its machine takes that long."""

SILENT_SECONDS = 5.0
"""The age of its last answer from which the witness is silent. It is asked every 0.3 s."""


UNCHECKED = (
    "since its start or the last change of the policy or the monitors, it still checks whether it could serve, which"
    " takes some seconds: try again then"
)
"""The obstacle of a standby before its first check ends. Earlier versions report it after each change as well."""

CHECKING = (
    "it still checks the last change of the policy or the monitors, which takes some seconds; until then it takes over"
    " only if the active appliance is away"
)
"""The obstacle of a standby that has passed a check before."""

CHECKS = frozenset({UNCHECKED, CHECKING})

MISFIT = "a change does not fit"
"""The beginning of a refusal of a standby whose tables are others, as those of an earlier version are."""


def takeover_obstacles(state: StandbyState, lease: str) -> list[str]:
    """Return why the standby could not take over now. `lease` is the judgement of the process `lease`, which notices
    a silent appliance sooner, but does not distinguish a standby that checks a change.
    """
    found = [trouble.text for trouble in standby_troubles(state)]
    return found or ([lease] if lease and state.obstacle != CHECKING else [])


def standby_troubles(state: StandbyState, patience: float = 0.0) -> Iterator[Trouble]:
    other, seconds = state.other, state.other.trouble_seconds or 0.0
    if both_active(state):
        holder = state.witness.holder
        text = (
            f"both appliances claim to be active: this one does, but the witness names {holder}, and the robot admits"
            f" only {holder}; stop this appliance, then start it again"
        )
        yield Trouble("both-active", text)
    if state.obstacle and seconds >= {UNCHECKED: patience, CHECKING: PATIENCE_SECONDS}.get(
        state.obstacle, 0.0
    ):
        yield _unready(state)
    if other.refusal and seconds >= patience:
        yield _refusing(state)
    elif not other.connected and seconds >= patience:
        yield _away(state, seconds)
    # A witness that refuses does not report who is in sync.
    if other.connected and not other.in_sync and not state.witness.refusal and seconds >= patience:
        yield _behind(state, seconds)
    if is_silent(state.witness):
        yield _silent(state.witness)
    elif state.witness.refusal and not both_active(state):
        yield _refused(state.witness)
    elif is_blind(other):
        yield _blind(state)
    elif state.witness.trouble:
        yield _unsaved(state.witness)


def present_troubles(state: StandbyState) -> Iterator[Trouble]:
    """Return the troubles of the active appliance and of other computers of the robot, which prevent no takeover."""
    if state.not_serving:
        other = state.other
        name, address = (state.name, state.address) if state.role == "active" else (other.name, other.address)
        text = f"the active appliance {name} ({address}) does not serve the robot: {state.not_serving}"
        yield Trouble("not-serving", text)
    if state.witness.follower_trouble and not is_silent(state.witness):
        text = (
            f"a computer that follows the witness reports: {state.witness.follower_trouble}; check its load there, and"
            " journalctl -u rosrv-witness-follow"
        )
        yield Trouble("follower-trouble", text)


def both_active(state: StandbyState) -> bool:
    witness = state.witness
    return state.role == "active" and not is_silent(witness) and witness.holder not in ("", state.name)


def is_silent(witness: WitnessSeen) -> bool:
    return witness.answered_seconds is None or witness.answered_seconds >= SILENT_SECONDS


def is_blind(other: OtherAppliance) -> bool:
    return other.connected and other.witness_seconds is not None and other.witness_seconds >= SILENT_SECONDS


def lag_of(other: OtherAppliance) -> str:
    changes = counted(other.behind_changes, "change")
    return f"{changes} ({other.behind_bytes} bytes) behind" if other.behind_changes else "catching up"


def lasting(seconds: float) -> str:
    for length, unit in ((86_400, "d"), (3600, "h"), (60, "min")):
        if seconds >= length:
            return f"{int(seconds // length)} {unit}"
    return f"{int(seconds)} s"


def _away(state: StandbyState, seconds: float) -> Trouble:
    other, away = state.other, lasting(seconds)
    why = f": {other.reason}" if other.reason else ""
    check = "check that it runs, and the network between the two"
    if state.role == "active":
        text = f"the standby {other.name} ({other.address}) has been away for {away}{why}; {check}"
    else:
        text = (
            f"the active appliance {other.name} ({other.address}) has not been connected for {away}, so its changes"
            f" since then are missing here{why}; {check}"
        )
    return Trouble("standby-away", text)


def _refusing(state: StandbyState) -> Trouble:
    active = state.role == "active"
    name, address = (state.other.name, state.other.address) if active else (state.name, state.address)
    text = (
        f"the standby {name} ({address}) does not follow, because it refuses what the active appliance sends:"
        f" {state.other.refusal}"
    )
    if MISFIT in text:
        text += f"; if the version of {name} is older (rosrv --version), upgrade it: until then there is no standby"
    return Trouble("standby-refuses", text)


def _unready(state: StandbyState) -> Trouble:
    active = state.role == "active"
    name, address = (state.other.name, state.other.address) if active else (state.name, state.address)
    text = f"the standby {name} ({address}) cannot take over: {state.obstacle}"
    if state.obstacle in CHECKS:
        return Trouble("standby-unchecked", text)
    text += f"; once this is corrected, {name} notices it within seconds"
    return Trouble("standby-unready", text)


def _behind(state: StandbyState, seconds: float) -> Trouble:
    other, remedy = state.other, "so it cannot take over; check the disk and the load of its machine"
    text = f"the standby {other.name} has been {lag_of(other)} for {lasting(seconds)}, {remedy}"
    if state.role == "standby":
        text = f"the standby {state.name} ({state.address}) lacks changes of {other.name}, {remedy}"
    return Trouble("standby-behind", text)


def _silent(witness: WitnessSeen) -> Trouble:
    seconds = witness.answered_seconds
    since = "has never answered" if seconds is None else f"has not answered for {lasting(seconds)}"
    text = (
        f"the witness on the robot ({witness.address}) {since}, so the standby cannot take over; check on the robot:"
        " systemctl status rosrv-witness"
    )
    return Trouble("witness-silent", text)


def _refused(witness: WitnessSeen) -> Trouble:
    text = (
        f"the witness on the robot ({witness.address}) refuses this appliance, so no takeover is possible:"
        f" {witness.refusal}"
    )
    return Trouble("witness-refuses", text)


def _blind(state: StandbyState) -> Trouble:
    other, witness = state.other, state.witness
    text = (
        f"the witness on the robot ({witness.address}) has not answered the standby {other.name} ({other.address}) for"
        f" {lasting(other.witness_seconds or 0)}, so the standby cannot take over; check the network between both"
    )
    return Trouble("standby-blind", text)


def _unsaved(witness: WitnessSeen) -> Trouble:
    text = (
        f"the witness on the robot ({witness.address}) could not carry out a takeover: {witness.trouble}; correct"
        " that on the robot"
    )
    return Trouble("witness-disk", text)
