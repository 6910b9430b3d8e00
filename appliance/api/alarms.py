"""What stands open now and should be looked at, read from the status: pure, and the same for every page."""

import datetime
from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import told
from appliance.channel.answers.status import Status
from appliance.channel.status_summary import no_relay, probe_failed


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """A condition that holds now. `kind` is a stable name; it goes by itself when the condition does."""

    kind: str
    severity: Literal["alarm", "warning", "notice"]
    text: Annotated[str, told("what is the matter and what to do, for a person")]
    about: Literal["system", "policy", "monitors", "hosts", "audit"]


def open_alarms(status: Status) -> list[Alarm]:
    """The open conditions, the gravest first."""
    order = ("alarm", "warning", "notice")
    found = [*_system(status), *_audit(status), *_policy(status), *_monitors(status), *_hosts(status)]
    found += _forgotten(status)
    return sorted(found, key=lambda alarm: order.index(alarm.severity))


def _system(status: Status) -> Iterator[Alarm]:
    if probe_failed(status):
        text = (
            f"the hidden ROS Master can be reached past the appliance; nodes are not served: {status.probe}"
        )
        yield Alarm(kind="probe", severity="alarm", text=text, about="system")
    relay = no_relay(status.relay)
    if relay is not None:
        text = f"{relay}, until it is back"
        yield Alarm(kind="relay", severity="alarm", text=text, about="system")
    if status.rosmaster != "reachable":
        text = "the ROS Master behind the appliance is being rebuilt; calls of nodes wait"
        yield Alarm(kind="rosmaster", severity="warning", text=text, about="system")


def _audit(status: Status) -> Iterator[Alarm]:
    audit = status.audit
    if audit.failed is not None:
        text = f"the audit log cannot be written: {audit.failed}"
        yield Alarm(kind="audit-failed", severity="alarm", text=text, about="audit")
    if audit.degraded is not None:
        yield Alarm(kind="audit-degraded", severity="warning", text=audit.degraded, about="audit")
    forwarding = audit.forwarding
    if forwarding is not None and forwarding.trouble:
        text = (
            f"the audit log is not forwarded to {forwarding.to}, {forwarding.behind} records wait:"
            f" {forwarding.trouble}"
        )
        yield Alarm(kind="audit-not-forwarded", severity="warning", text=text, about="audit")


def _policy(status: Status) -> Iterator[Alarm]:
    policy = status.policy
    if policy.confirm_by is not None:
        text = f"revision {policy.revision} goes back by itself unless it is confirmed"
        yield Alarm(kind="policy-unconfirmed", severity="warning", text=text, about="policy")
    if policy.audit_only:
        text = (
            f"the policy refuses nothing by [{'], ['.join(policy.audit_only)}], it only records (audit-only)"
        )
        yield Alarm(kind="policy-audit-only", severity="warning", text=text, about="policy")
    if policy.differs_from_file:
        text = f"revision {policy.revision} is not what {policy.file} says"
        yield Alarm(kind="policy-differs", severity="notice", text=text, about="policy")


def _forgotten(status: Status) -> Iterator[Alarm]:
    for off in status.switched_off:
        if off.forgotten:
            text = f"{off.what} since {_moment(off.since)}: {off.again}"
            yield Alarm(kind=f"forgotten:{off.name}", severity="alarm", text=text, about=off.about)
        elif off.about == "monitors":
            end = "without an end" if off.until is None else f"until {_moment(off.until)}"
            text = f"{off.what}, {end}: {off.again}"
            yield Alarm(kind=f"monitor-off:{off.name}", severity="notice", text=text, about="monitors")


def _monitors(status: Status) -> Iterator[Alarm]:
    monitors = status.monitors
    for name in monitors.held:
        why = monitors.why_held.get(name, "a relay was restarted")
        text = f"{name} holds its topics: {why}; resume it when that is safe (rosrv monitor resume {name})"
        yield Alarm(kind=f"monitor-held:{name}", severity="alarm", text=text, about="monitors")
    for name in monitors.failing:
        text = f"{name} is failing: its actions faulted again and again"
        yield Alarm(kind=f"monitor-failing:{name}", severity="alarm", text=text, about="monitors")
    for line in monitors.refused:
        yield Alarm(kind="monitors-refused", severity="warning", text=line, about="monitors")
    if monitors.confirm_by is not None:
        text = (
            f"revision {monitors.revision} of the specifications goes back by itself unless it is confirmed"
        )
        yield Alarm(kind="monitors-unconfirmed", severity="warning", text=text, about="monitors")
    if monitors.differs_from_folder:
        text = f"revision {monitors.revision} of the specifications is not what their folder has"
        yield Alarm(kind="monitors-differ", severity="notice", text=text, about="monitors")


def _hosts(status: Status) -> Iterator[Alarm]:
    for line in status.ipsec.troubles:
        yield Alarm(kind="ipsec", severity="warning", text=line, about="hosts")


def _moment(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
