"""Show two appliances in the status, the alarms and the metrics."""

from appliance.base.metric import counter, gauge
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.samples import samples_of
from appliance.features.standby.status_line import standby_line
from appliance.features.standby.summary import PATIENCE_SECONDS, follower_troubles, standby_troubles
from appliance.features.view import FeatureView, StateView

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
    "standby",
    (
        StateView(
            "standby",
            StandbyState,
            "this appliance as one of two, or null on a single one",
            before="handled_alarms",
            alarms=lambda state: (*standby_troubles(state, PATIENCE_SECONDS), *follower_troubles(state)),
            metrics=_METRICS,
            samples=samples_of,
            line=standby_line,
        ),
    ),
    pair="appliance.features.standby.pair_view:StandbyPairView",
    passive_status="appliance.features.standby.standby_view:standby_view",
    verification="appliance.features.standby.takeover_table:verification",
)
