"""What is measured: every metric by name, and the counters that RVMaster keeps.

`METRICS` is the one list that `/metrics` is made from and docs/metrics.md is generated from
(`python -m appliance.metrics`). Counting is a few additions on the way of a request; nothing is formatted there.
Labels have few values: names of calls, categories and roles are ours; topics and services are those that are carried,
and only so many of them by name (`appliance.control.measures`).
"""

import bisect
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from appliance.channel.messages import DELAY_BOUNDS

BOUNDS = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)  # seconds


class Metric(NamedTuple):
    """One metric; `name` as Prometheus shows it."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    help: str
    bounds: tuple[float, ...] = BOUNDS
    """Of a histogram, in seconds."""


METRICS = (
    Metric("rosrv_info", "gauge", ("version",), "1, with the version that runs"),
    Metric("rosrv_start_time_seconds", "gauge", (), "when RVMaster started, seconds since the epoch"),
    Metric(
        "rosrv_decisions_total", "counter", ("category", "outcome"), "decisions: allow, deny or would deny"
    ),
    Metric("rosrv_decision_seconds", "histogram", (), "from a request's arrival to its decision"),
    Metric("rosrv_master_call_seconds", "histogram", ("call",), "from a request's arrival to its answer"),
    Metric(
        "rosrv_probe_failed", "gauge", (), "1 while the hidden ROS Master can be reached past the appliance"
    ),
    Metric("rosrv_relay_connected", "gauge", (), "1 while every relay process is there"),
    Metric(
        "rosrv_relay_connections", "gauge", ("kind",), "subscribers (topic) and clients (service) connected"
    ),
    Metric("rosrv_relay_messages_total", "counter", ("resource",), "messages relayed, by topic or service"),
    Metric("rosrv_relay_bytes_total", "counter", ("resource",), "bytes relayed, by topic or service"),
    Metric(
        "rosrv_relay_dropped_total", "counter", ("resource",), "messages that slow subscribers did not get"
    ),
    Metric(
        "rosrv_relay_limited_total",
        "counter",
        ("resource", "part"),
        "messages that limits of the policy dropped: of a publisher, a subscriber, a topic",
    ),
    Metric(
        "rosrv_relay_memory_bytes",
        "gauge",
        ("what",),
        "bytes that hosts hold in the relays: frames (unfinished), queues, latched, headers",
    ),
    Metric(
        "rosrv_relay_delay_seconds",
        "histogram",
        ("resource",),
        "messages by the delay the relay and its monitors added, by topic",
        DELAY_BOUNDS,
    ),
    Metric("rosrv_monitor_dropped_total", "counter", ("resource",), "messages that monitors dropped"),
    Metric("rosrv_monitor_changed_total", "counter", ("resource",), "messages that monitors changed"),
    Metric(
        "rosrv_monitor_events_total",
        "counter",
        ("kind", "monitor"),
        "what monitors did: verdict, drop, change, fault, log, publish; what several changed counts for each;"
        " `trial drop`, … of those on trial",
    ),
    Metric(
        "rosrv_monitor_margin",
        "gauge",
        ("monitor", "place", "holds"),
        "how close a comparison of numbers at this line and column came today (UTC) while it was true, and while not",
    ),
    Metric("rosrv_monitor_slices", "gauge", ("monitor",), "slices that a parametric specification has now"),
    Metric("rosrv_monitor_slice_limit", "gauge", ("monitor",), "slices that it may have at a time"),
    Metric("rosrv_monitors", "gauge", ("state",), "monitors: enabled, trial, disabled, holding, failing"),
    Metric("rosrv_nodes", "gauge", ("state",), "nodes: live, or lost and awaited"),
    Metric("rosrv_registrations", "gauge", ("kind",), "registrations of live nodes"),
    Metric("rosrv_rosmaster_reachable", "gauge", (), "1 while the real ROS Master answers"),
    Metric("rosrv_delivery_queue", "gauge", (), "calls that wait to be made to nodes"),
    Metric("rosrv_tunnel_up", "gauge", ("host",), "1 while the tunnel of an enrolled host stands"),
    Metric("rosrv_tunnel_age_seconds", "gauge", ("host",), "age of the SA; 0 while there is none"),
    Metric(
        "rosrv_tunnel_bytes",
        "gauge",
        ("host", "direction"),
        "bytes of the present SA: in (from the host), out",
    ),
    Metric(
        "rosrv_host_certificate_expiry_seconds",
        "gauge",
        ("host",),
        "until a host's certificate ends, negative once it has",
    ),
    Metric(
        "rosrv_host_ports_open",
        "gauge",
        ("host",),
        "1 if a check from outside found ROS ports open, 0 if closed, -1 not known",
    ),
    Metric("rosrv_hosts", "gauge", ("state",), "hosts by state, as `rosrv host list` shows it"),
    Metric("rosrv_ipsec_troubles", "gauge", (), "what `rosrv status` says is wrong with IPsec, in number"),
    Metric("rosrv_audit_queue", "gauge", (), "audit records that wait to be on disk"),
    Metric("rosrv_audit_lag_seconds", "gauge", (), "how long the oldest of them has waited"),
    Metric("rosrv_audit_failed", "gauge", (), "1 while the audit log cannot be written"),
    Metric(
        "rosrv_audit_degraded",
        "gauge",
        (),
        "1 while checkpoints, the full-text index or retention are behind, or its disk is nearly full",
    ),
    Metric("rosrv_syslog_up", "gauge", (), "1 while the audit log is forwarded; absent when it is not to be"),
    Metric(
        "rosrv_syslog_sent_total", "counter", (), "messages the receiver has, since the forwarder started"
    ),
    Metric("rosrv_syslog_lag_records", "gauge", (), "audit records that wait to be forwarded"),
    Metric("rosrv_syslog_lag_seconds", "gauge", (), "how long the oldest of them has waited"),
    Metric(
        "rosrv_syslog_missed_total",
        "counter",
        (),
        "records that retention removed before they were forwarded",
    ),
    Metric(
        "rosrv_clock_synchronised",
        "gauge",
        (),
        "1 while a time service keeps the machine's clock, 0 while none does, -1 not known",
    ),
    Metric(
        "rosrv_clock_behind_seconds",
        "gauge",
        (),
        "the clock was set back: it stands so long before the last record",
    ),
    Metric(
        "rosrv_recorder_up", "gauge", (), "1 while the flight recorder runs; absent when nothing is recorded"
    ),
    Metric("rosrv_recordings", "gauge", (), "recordings that are kept"),
    Metric("rosrv_recordings_bytes", "gauge", (), "bytes of them"),
    Metric("rosrv_policy_revision", "gauge", (), "revision of the policy in force"),
    Metric("rosrv_policy_differs_from_file", "gauge", (), "1 while the policy in force is not the file's"),
    Metric("rosrv_process_restarts_total", "counter", ("role",), "times a process was started again"),
    Metric("rosrv_process_resident_bytes", "gauge", ("role",), "memory of a process"),
    Metric("rosrv_rest_calls_total", "counter", ("method", "status"), "REST calls since the api started"),
)


@dataclass(slots=True)
class Histogram:
    """How many were at most so long; `counts` has one more place than `BOUNDS`, for those beyond."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS) + 1))
    sum: float = 0.0

    def observe(self, seconds: float) -> None:
        """Count one."""
        self.counts[bisect.bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds

    def values(self) -> tuple[list[int], float]:
        """The counts and the sum."""
        return self.counts, self.sum


class Meter:
    """The counters of RVMaster, since it started."""

    def __init__(self) -> None:
        self.decisions: Counter[tuple[str, str]] = Counter()
        self.decision_seconds = Histogram()
        self.calls: dict[str, Histogram] = {}

    def decided(self, category: str, outcome: str, seconds: float) -> None:
        """A decision was made."""
        self.decisions[category, outcome] += 1
        self.decision_seconds.observe(seconds)

    def called(self, call: str, seconds: float) -> None:
        """A call of the table was answered (`call` must not be a stranger's text)."""
        histogram = self.calls.get(call)
        if histogram is None:
            histogram = self.calls[call] = Histogram()
        histogram.observe(seconds)


def markdown() -> str:
    """The generated part of the page on metrics."""
    lines = ["| metric | kind | labels | meaning |", "|---|---|---|---|"]
    lines += [
        f"| `{row.name}` | {row.kind} | {', '.join(f'`{label}`' for label in row.labels) or '-'} | {row.help} |"
        for row in METRICS
    ]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.stdout.write(markdown())
