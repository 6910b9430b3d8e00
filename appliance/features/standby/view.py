"""Show two appliances in the status, the alarms and the metrics."""

import math

from appliance.base.metric import counter, gauge
from appliance.features.standby.answers import OtherAppliance, StandbyState, WitnessSeen
from appliance.features.standby.summary import (
    PATIENCE_SECONDS,
    both_active,
    is_silent,
    lag_of,
    lasting,
    present_troubles,
    standby_troubles,
)
from appliance.features.view import AlarmKind, FeatureView, PairView, Pieces, Samples, StateView

# Write the state of two appliances in one line.


def standby_line(state: StandbyState) -> tuple[str, Pieces]:
    other, witness = lag_in_words(state.other), answer_in_words(state.witness)
    line = f"{state.name} is {state.role}; {state.other.name}: {other}; witness: {witness}"
    return "standby", [(line, "yellow" if state.troubles else "")]


def lag_in_words(other: OtherAppliance) -> str:
    if other.connected:
        return "in sync" if other.in_sync else lag_of(other)
    return connection(other)


def answer_in_words(witness: WitnessSeen) -> str:
    seconds = witness.answered_seconds
    if seconds is None:
        return "has never answered"
    if is_silent(witness):
        return f"silent for {lasting(seconds)}"
    return "refuses" if witness.refusal else "answers"


def connection(other: OtherAppliance) -> str:
    if other.connected:
        return "connected"
    away = "" if other.trouble_seconds is None else f" for {lasting(other.trouble_seconds)}"
    return f"away{away}" + (f": {other.reason}" if other.reason else "")


# The samples of the metrics of two appliances.


def samples_of(state: StandbyState) -> dict[str, Samples]:
    other, answered, active = state.other, state.witness.answered_seconds, state.role == "active"
    return {
        "rosrv_standby_role": [((role,), state.role == role) for role in ("active", "standby")],
        "rosrv_standby_connected": [((), other.connected)],
        "rosrv_standby_in_sync": [((), other.in_sync)] if active else [],
        "rosrv_standby_can_take_over": [((), not state.troubles)],
        "rosrv_standby_obstacle": [((), bool(state.obstacle))],
        "rosrv_standby_behind_changes": [((), other.behind_changes)] if active else [],
        "rosrv_standby_behind_bytes": [((), other.behind_bytes)] if active else [],
        "rosrv_standby_witness_age_seconds": [((), math.inf if answered is None else answered)],
        "rosrv_standby_other_witness_age_seconds": [((), seen)]
        if (seen := other.witness_seconds) is not None
        else [],
        "rosrv_standby_witness_trouble": [((), bool(state.witness.trouble or state.witness.refusal))],
        "rosrv_standby_both_active": [((), both_active(state))] if active else [],
        # Until the epoch is known after a restart: a counter that falls to 0 and returns would look like takeovers.
        "rosrv_standby_takeovers_total": [((), state.epoch)] if state.epoch else [],
    }


_METRICS = (
    gauge(
        "rosrv_standby_role",
        "1 for the role of this appliance, 0 for the other: active, standby;"
        " absent, like all `rosrv_standby` metrics, if it is not one of two",
        "role",
    ),
    gauge("rosrv_standby_connected", "1 while the replication between the two appliances is open"),
    gauge("rosrv_standby_in_sync", "1 while the standby has all changes; only on the active appliance"),
    gauge(
        "rosrv_standby_can_take_over",
        "1 while the standby could take over now, as `rosrv standby status` reports",
    ),
    gauge("rosrv_standby_obstacle", "1 while the standby follows, but could not start if it took over"),
    gauge("rosrv_standby_behind_changes", "changes that the standby lacks; only on the active appliance"),
    gauge("rosrv_standby_behind_bytes", "bytes of these changes in memory; only on the active appliance"),
    gauge(
        "rosrv_standby_witness_age_seconds",
        "time since the last answer of the witness; +Inf if it never answered",
    ),
    gauge(
        "rosrv_standby_other_witness_age_seconds",
        "time since the witness last answered the standby; only on the active appliance, once the standby has reported",
    ),
    gauge(
        "rosrv_standby_witness_trouble",
        "1 while the witness could not carry out a takeover, such as on a disk that cannot be written, or refuses this"
        " appliance",
    ),
    gauge(
        "rosrv_standby_both_active",
        "1 while this appliance is active, but the witness names the other; only on the active appliance",
    ),
    counter(
        "rosrv_standby_takeovers_total",
        "takeovers since the two appliances were joined: the epoch that this appliance knows last",
    ),
)


STANDBY_VIEW = FeatureView(
    (
        StateView(
            "standby",
            StandbyState,
            "this appliance as one of two, or null on a single one",
            before="handled_alarms",
            kinds={
                "not-serving": AlarmKind(
                    "alarm", "correct why the active appliance does not serve the robot"
                ),
                "standby-refuses": AlarmKind("alarm", "correct why the standby refuses the changes"),
                "both-active": AlarmKind("alarm", "stop this appliance, then start it again"),
                "standby-unready": AlarmKind("alarm", "correct why the standby could not take over"),
                "standby-unchecked": AlarmKind("warning", "its check takes unusually long"),
                "standby-away": AlarmKind("warning", "start the other appliance, or repair the network"),
                "standby-behind": AlarmKind("warning", "check the disk and the load of its machine"),
                "standby-blind": AlarmKind("alarm", "repair the network between standby and robot"),
                "witness-silent": AlarmKind("warning", "start the witness on the robot"),
                "witness-refuses": AlarmKind("alarm", "correct why the witness refuses"),
                "witness-disk": AlarmKind("alarm", "free the disk of the robot"),
                "follower-trouble": AlarmKind("warning", "check the load of that computer"),
            },
            alarms=lambda state: (*standby_troubles(state, PATIENCE_SECONDS), *present_troubles(state)),
            metrics=_METRICS,
            samples=samples_of,
            line=standby_line,
        ),
    ),
    PairView(
        "appliance.features.standby.requests:StandbyWanted",
        samples_of,
        "appliance.features.standby.live_verbs:standby_view",
        "appliance.features.standby.takeover_table:verification",
    ),
)
