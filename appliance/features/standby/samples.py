"""The samples of the metrics of two appliances."""

import math

from appliance.features.standby.answers import StandbyState
from appliance.features.standby.summary import both_active
from appliance.features.view import Samples


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
