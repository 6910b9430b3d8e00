"""Show the forwarding to a syslog receiver in the status, the alarms and the metrics."""

from collections.abc import Iterator

from appliance.base.counted import counted
from appliance.base.metric import counter, gauge
from appliance.features.view import AlarmKind, FeatureView, StateView, Trouble
from appliance.forwarding.forwarding_state import ForwardingState, samples_of

_METRICS = (
    gauge("rosrv_syslog_up", "1 while the audit log is forwarded; absent if forwarding is not configured"),
    counter("rosrv_syslog_sent_total", "messages that the receiver got since the forwarder started"),
    gauge("rosrv_syslog_lag_records", "audit records that wait to be forwarded"),
    gauge("rosrv_syslog_lag_seconds", "how long the oldest such record has waited"),
    counter("rosrv_syslog_missed_total", "records that retention removed before they were forwarded"),
)


def _alarms(state: ForwardingState) -> Iterator[Trouble]:
    if state.trouble:
        where = f"the audit log is not forwarded to {state.to}, {counted(state.behind, 'record waits', 'records wait')}"
        yield Trouble("audit-not-forwarded", f"{where}: {state.trouble}", "audit")


SYSLOG_VIEW = FeatureView(
    (
        StateView(
            "forwarding",
            ForwardingState,
            "the forwarding of records, or null if it is not configured",
            part="audit",
            required=True,
            kinds={
                "audit-not-forwarded": AlarmKind("warning", "repair the receiver; records wait on the disk")
            },
            alarms=_alarms,
            metrics=_METRICS,
            samples=lambda state: samples_of("syslog", state),
            line=lambda state: ("", f"{state.behind} to be forwarded to {state.to}"),
        ),
    ),
)
