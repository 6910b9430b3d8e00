"""Define every metric by name, and keep the counters of RVMaster.

`/metrics` and docs/reference/metrics.md are both generated from `METRICS` (`python -m appliance.telemetry.metrics`).
Counting costs a few additions per request and no formatting. Labels have few values. Calls, categories and roles are
fixed sets. Only topics and services on a relay are labels; `control.operators.measurements` limits their number.
"""

import bisect
import sys
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from appliance.base import clock
from appliance.channel.messages import DELAY_BOUNDS

_SECONDS = 60


class LastMinute:
    """Counts of the last 60 seconds, one for each second and name; `clock` returns seconds and is never set back.

    The caller limits the number of names.
    """

    def __init__(self, clock: Callable[[], float] = clock.now) -> None:
        self._clock = clock
        self._seconds: deque[tuple[int, Counter[str]]] = deque(maxlen=_SECONDS)

    def add(self, name: str, number: int = 1) -> None:
        """Count events that happen now."""
        second = int(self._clock())
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, Counter()))
        self._seconds[-1][1][name] += number

    def counts(self) -> dict[str, int]:
        """Return the number of events in the last minute for each name that had any."""
        oldest = int(self._clock()) - _SECONDS
        total: Counter[str] = Counter()
        for second, counts in self._seconds:
            if second > oldest:
                total.update(counts)
        return dict(total)


BOUNDS = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)  # seconds


class Metric(NamedTuple):
    """A metric; `name` is its name in Prometheus."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    help: str
    bounds: tuple[float, ...] = BOUNDS
    """The bounds of a histogram in seconds."""


def _counter(name: str, help: str, *labels: str) -> Metric:  # noqa: A002  as Prometheus's own client calls it
    return Metric(name, "counter", labels, help)


def _gauge(name: str, help: str, *labels: str) -> Metric:  # noqa: A002  as above
    return Metric(name, "gauge", labels, help)


def _histogram(name: str, help: str, *labels: str, bounds: tuple[float, ...] = BOUNDS) -> Metric:  # noqa: A002  as above
    return Metric(name, "histogram", labels, help, bounds)


METRICS = (
    _gauge("rosrv_info", "1, with the version that runs, and the robot's name", "version", "name"),
    _gauge("rosrv_start_time_seconds", "when RVMaster started, seconds since the epoch"),
    _counter("rosrv_decisions_total", "decisions: allow, deny or would deny", "category", "outcome"),
    _histogram("rosrv_decision_seconds", "time from a request's arrival to its decision"),
    _histogram("rosrv_master_call_seconds", "time from a request's arrival to its answer", "call"),
    _gauge("rosrv_probe_failed", "1 while the hidden ROS master is reachable without the appliance"),
    _gauge("rosrv_relay_connected", "1 while all relay processes are connected"),
    _gauge("rosrv_relay_connections", "subscribers (topic) and clients (service) connected", "kind"),
    _counter("rosrv_relay_messages_total", "messages relayed, by topic or service", "resource"),
    _counter("rosrv_relay_bytes_total", "bytes relayed, by topic or service", "resource"),
    _counter("rosrv_relay_dropped_total", "messages dropped for slow subscribers", "resource"),
    _counter(
        "rosrv_relay_limited_total",
        "messages dropped by limits of the policy, by kind of limit: publisher, subscriber, topic",
        "resource",
        "part",
    ),
    _gauge(
        "rosrv_relay_memory_bytes",
        "bytes that hosts hold in the relays: frames (unfinished), queues, latched, headers",
        "what",
    ),
    _histogram(
        "rosrv_relay_delay_seconds",
        "messages by the delay the relay and its monitors added, by topic",
        "resource",
        bounds=DELAY_BOUNDS,
    ),
    _counter("rosrv_monitor_dropped_total", "messages that monitors dropped", "resource"),
    _counter("rosrv_monitor_changed_total", "messages that monitors changed", "resource"),
    _counter(
        "rosrv_monitor_events_total",
        "actions of monitors: verdict, drop, change, fault, log, publish, call; a change by several counts for each;"
        " `shadow drop`, … for monitors in shadow mode",
        "kind",
        "monitor",
    ),
    _gauge("rosrv_monitor_slices", "slices of a parametric specification", "monitor"),
    _gauge("rosrv_monitor_slice_limit", "the most slices that a specification may have at a time", "monitor"),
    _gauge("rosrv_monitors", "monitors: enabled, shadow (mode), disabled, holding, failing", "state"),
    _gauge(
        "rosrv_switched_off",
        "monitors disabled or in shadow mode by an order, and audit-only sections of the policy: forgotten, or not yet",
        "about",
        "state",
    ),
    _gauge("rosrv_nodes", "nodes: live, or lost and expected back", "state"),
    _gauge("rosrv_registrations", "registrations of live nodes", "kind"),
    _gauge("rosrv_rosmaster_reachable", "1 while the ROS master answers"),
    _gauge("rosrv_delivery_queue", "calls to nodes that wait to be sent"),
    _gauge("rosrv_tunnel_up", "1 while the tunnel of an enrolled host is up", "host"),
    _gauge("rosrv_tunnel_age_seconds", "age of the SA; 0 without an SA", "host"),
    _gauge("rosrv_tunnel_bytes", "bytes of the current SA: in (from the host), out", "host", "direction"),
    _gauge(
        "rosrv_host_certificate_expiry_seconds",
        "time until a host's certificate expires; negative once expired",
        "host",
    ),
    _gauge(
        "rosrv_host_ports_open",
        "1 if a check from outside found ROS ports open, 0 if closed, -1 if not known",
        "host",
    ),
    _gauge("rosrv_hosts", "hosts by state, as `rosrv host list` shows it", "state"),
    _gauge("rosrv_hosts_blocked", "hosts that operators block (`rosrv host blocks`)"),
    _gauge("rosrv_ipsec_troubles", "number of IPsec problems that `rosrv status` reports"),
    _gauge("rosrv_audit_queue", "audit records that wait to be written to disk"),
    _gauge("rosrv_audit_lag_seconds", "how long the oldest such record has waited"),
    _gauge("rosrv_audit_failed", "1 while the audit log cannot be written"),
    _gauge(
        "rosrv_audit_degraded",
        "1 while checkpoints, the full-text index or retention are behind, or its disk is nearly full",
    ),
    _gauge("rosrv_bundle_version", "version of the fleet's bundle in force; 0: none; absent without a fleet"),
    _gauge("rosrv_bundle_refused", "1 while the last bundle that was offered is refused"),
    _gauge("rosrv_bundle_changed", "1 while a part of the bundle in force is changed on this robot"),
    _gauge("rosrv_bundle_checked_seconds", "since the collector's metadata were last verified; -1: not yet"),
    _gauge("rosrv_bundle_rejected", "1 while the collector serves bundles or metadata that are not accepted"),
    _gauge("rosrv_syslog_up", "1 while the audit log is forwarded; absent if forwarding is not configured"),
    _counter("rosrv_syslog_sent_total", "messages that the receiver got since the forwarder started"),
    _gauge("rosrv_syslog_lag_records", "audit records that wait to be forwarded"),
    _gauge("rosrv_syslog_lag_seconds", "how long the oldest such record has waited"),
    _counter("rosrv_syslog_missed_total", "records that retention removed before they were forwarded"),
    _gauge(
        "rosrv_collector_up", "1 while segments are pushed to the collector; absent if none is configured"
    ),
    _counter("rosrv_collector_sent_total", "segments with a receipt since the pusher started"),
    _gauge("rosrv_collector_lag_records", "sealed audit records that the collector does not have"),
    _gauge("rosrv_collector_lag_seconds", "how long the oldest such record has waited"),
    _counter("rosrv_collector_missed_total", "records that retention removed before the collector had them"),
    _gauge(
        "rosrv_clock_synchronised",
        "1 while a time service synchronises the machine's clock, 0 while none does, -1 if not known",
    ),
    _gauge(
        "rosrv_clock_behind_seconds", "how far the clock is behind the last record, because it was set back"
    ),
    _gauge("rosrv_recorder_up", "1 while the flight recorder runs; absent if recording is off"),
    _gauge("rosrv_recordings", "stored recordings"),
    _gauge("rosrv_recordings_bytes", "bytes of the stored recordings"),
    _gauge(
        "rosrv_standby_role",
        "1 for the role of this appliance, 0 for the other: active, standby;"
        " absent, like all `rosrv_standby` metrics, if it is not one of two",
        "role",
    ),
    _gauge("rosrv_standby_connected", "1 while the replication between the two appliances is open"),
    _gauge("rosrv_standby_in_sync", "1 while the standby has all changes; only on the active appliance"),
    _gauge("rosrv_standby_obstacle", "1 while the standby follows, but could not start if it took over"),
    _gauge("rosrv_standby_behind_changes", "changes that the standby lacks; only on the active appliance"),
    _gauge("rosrv_standby_behind_bytes", "bytes of these changes in memory; only on the active appliance"),
    _gauge(
        "rosrv_standby_witness_age_seconds",
        "time since the last answer of the witness; +Inf if it never answered",
    ),
    _gauge(
        "rosrv_standby_other_witness_age_seconds",
        "time since the witness last answered the standby; only on the active appliance, once the standby has reported",
    ),
    _gauge(
        "rosrv_standby_witness_trouble",
        "1 while the witness could not save a takeover, such as on a disk that cannot be written",
    ),
    _gauge(
        "rosrv_standby_both_active",
        "1 while this appliance is active, but the witness names the other; only on the active appliance",
    ),
    _counter(
        "rosrv_standby_takeovers_total",
        "takeovers since the two appliances were joined: the epoch that this appliance knows last",
    ),
    _gauge("rosrv_policy_revision", "revision of the policy in force"),
    _gauge("rosrv_policy_differs_from_file", "1 while the policy in force differs from its file"),
    _counter("rosrv_process_restarts_total", "times a process was started again", "role"),
    _gauge("rosrv_process_resident_bytes", "memory of a process", "role"),
    _counter("rosrv_rest_calls_total", "REST calls since the api started", "method", "status"),
)


@dataclass(slots=True)
class Histogram:
    """A histogram of durations by upper bound; the last entry of `counts` is for durations above all `BOUNDS`."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS) + 1))
    sum: float = 0.0

    def observe(self, seconds: float) -> None:
        """Count one duration."""
        self.counts[bisect.bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds

    def values(self) -> tuple[list[int], float]:
        """Return the counts and the sum."""
        return self.counts, self.sum


class Meter:
    """The counters of RVMaster's events since its start, and of the last minute.

    `denied` has the denials by category, `denied_hosts` by host (unknown hosts together, as ""), `dropped` the messages
    that monitors dropped by monitor.
    """

    def __init__(self) -> None:
        self.decisions: Counter[tuple[str, str]] = Counter()
        self.decision_seconds = Histogram()
        self.calls: dict[str, Histogram] = {}
        self.denied = LastMinute()
        self.denied_hosts = LastMinute()
        self.dropped = LastMinute()

    def decided(self, category: str, outcome: str, seconds: float, host: str) -> None:
        """Count a decision about a host; unknown hosts are one, without a name."""
        self.decisions[category, outcome] += 1
        if outcome == "deny":
            self.denied.add(category)
            self.denied_hosts.add(host)
        self.decision_seconds.observe(seconds)

    def called(self, call: str, seconds: float) -> None:
        """Count an answered call; `call` is a name of the call table, never text from a client."""
        histogram = self.calls.get(call)
        if histogram is None:
            histogram = self.calls[call] = Histogram()
        histogram.observe(seconds)


def markdown() -> str:
    """Return the generated part of docs/reference/metrics.md."""
    lines = ["| metric | kind | labels | meaning |", "|---|---|---|---|"]
    lines += [
        f"| `{row.name}` | {row.kind} | {', '.join(f'`{label}`' for label in row.labels) or '-'} | {row.help} |"
        for row in METRICS
    ]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.stdout.write(markdown())
