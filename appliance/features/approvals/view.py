"""The counts of approvals, with their alarm and metrics."""

from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.base.counted import counted
from appliance.base.metric import gauge
from appliance.channel.answers.field_docs import doc
from appliance.features.view import AlarmKind, FeatureView, StateView, Trouble

_METRICS = (
    gauge("rosrv_approvals_waiting", "calls that wait for an operator's approval"),
    gauge("rosrv_approvals_oldest_wait_seconds", "how long the oldest of these calls has waited"),
    gauge("rosrv_approvals_leases", "approvals that let a host publish, call or write for some time"),
    gauge("rosrv_approvals_unanswered", "calls that no operator answered in time, in the last ten minutes"),
    gauge("rosrv_approvals_unsent", "calls that the web hook did not get, in the last ten minutes"),
)


class ApprovalCounts(msgspec.Struct, frozen=True):
    """The numbers of waiting calls and of valid approvals."""

    waiting: Annotated[int, doc("calls that wait for an operator")]
    oldest_seconds: Annotated[float, doc("how long the oldest of them has waited")]
    leases: Annotated[int, doc("approvals that last for some time")]
    unanswered: Annotated[int, doc("calls that no operator answered in time, in the last ten minutes")]
    unsent: Annotated[
        int,
        doc("calls that the web hook did not get, in the last ten minutes, since the last that it got"),
    ] = 0
    unsent_why: Annotated[str, doc("why the last of them was not sent, or empty")] = ""


def _alarms(state: ApprovalCounts) -> Iterator[Trouble]:
    if state.unanswered:
        text = (
            f"no operator answered {counted(state.unanswered, 'call')} in time, in the last ten minutes:"
            " rosrv approve"
        )
        yield Trouble("approval-unanswered", text)
    if state.unsent:
        text = f"the web hook did not get {counted(state.unsent, 'waiting call')}: {state.unsent_why}"
        yield Trouble("approval-hook", text)


def _line(state: ApprovalCounts) -> tuple[str, str]:
    calls = "call waits" if state.waiting == 1 else "calls wait"
    return (
        "approvals",
        f"{state.waiting} {calls}, {state.leases} {'approval' if state.leases == 1 else 'approvals'} for some time",
    )


APPROVALS_VIEW = FeatureView(
    (
        StateView(
            "approvals",
            ApprovalCounts,
            "calls that wait for an operator's approval, and approvals",
            kinds={
                "approval-unanswered": AlarmKind(
                    "warning", "see that an operator answers; it ends after ten minutes"
                ),
                "approval-hook": AlarmKind("warning", "repair the receiver of the web hook"),
            },
            alarms=_alarms,
            line=_line,
            metrics=_METRICS,
            samples=lambda state: {
                "rosrv_approvals_waiting": [((), state.waiting)],
                "rosrv_approvals_oldest_wait_seconds": [((), state.oldest_seconds)],
                "rosrv_approvals_leases": [((), state.leases)],
                "rosrv_approvals_unanswered": [((), state.unanswered)],
                "rosrv_approvals_unsent": [((), state.unsent)],
            },
        ),
    ),
)
