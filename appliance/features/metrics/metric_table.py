"""List every metric.

Labels have few values; `control.operators.measurements` limits the number of topics and services.
"""

from appliance.base.metric import counter, gauge, histogram
from appliance.channel.messages import DELAY_BOUNDS
from appliance.features.views import STATES

METRICS = (
    gauge("rosrv_info", "1, with the version that runs, and the robot's name", "version", "name"),
    gauge("rosrv_start_time_seconds", "when RVMaster started, seconds since the epoch"),
    counter(
        "rosrv_decisions_total",
        "decisions: allow, would deny, ask (waits for an approval), deny (also of unknown and blocked hosts)",
        "category",
        "outcome",
    ),
    histogram("rosrv_decision_seconds", "time from a request's arrival to its decision"),
    histogram("rosrv_master_call_seconds", "time from a request's arrival to its answer", "call"),
    gauge("rosrv_probe_failed", "1 while the ROS master is, or may be, reachable without the appliance"),
    gauge("rosrv_relay_connected", "1 while all relay processes are connected"),
    gauge("rosrv_relay_connections", "subscribers (topic) and clients (service) connected", "kind"),
    counter("rosrv_relay_messages_total", "messages relayed, by topic or service", "resource"),
    counter("rosrv_relay_bytes_total", "bytes relayed, by topic or service", "resource"),
    counter("rosrv_relay_dropped_total", "messages dropped for slow subscribers", "resource"),
    counter(
        "rosrv_relay_limited_total",
        "messages dropped by limits of the policy, by kind of limit: publisher, subscriber, topic",
        "resource",
        "part",
    ),
    gauge(
        "rosrv_relay_memory_bytes",
        "bytes that hosts hold in the relays: frames (unfinished), queues, latched, headers",
        "what",
    ),
    histogram(
        "rosrv_relay_delay_seconds",
        "messages by the delay the relay and its monitors added, by topic",
        "resource",
        bounds=DELAY_BOUNDS,
    ),
    counter("rosrv_monitor_dropped_total", "messages that monitors dropped", "resource"),
    counter("rosrv_monitor_changed_total", "messages that monitors changed", "resource"),
    counter(
        "rosrv_monitor_events_total",
        "actions of monitors: verdict, drop, change, fault, log, publish, call; a change by several counts for each;"
        " `shadow drop`, … for monitors in shadow mode",
        "kind",
        "monitor",
    ),
    gauge("rosrv_monitor_slices", "slices of a parametric specification", "monitor"),
    gauge("rosrv_monitor_slice_limit", "the most slices that a specification may have at a time", "monitor"),
    gauge(
        "rosrv_monitors",
        "monitors: enabled, shadow (mode), disabled, holding, failing, broken (files)",
        "state",
    ),
    gauge(
        "rosrv_switched_off",
        "monitors disabled or in shadow mode by an order, and audit-only sections of the policy: forgotten, or not yet",
        "about",
        "state",
    ),
    gauge("rosrv_nodes", "nodes: live, or lost and expected back", "state"),
    gauge("rosrv_registrations", "registrations of live nodes", "kind"),
    gauge("rosrv_rosmaster_reachable", "1 while the ROS master answers"),
    gauge("rosrv_delivery_queue", "calls to nodes that wait to be sent"),
    gauge("rosrv_tunnel_up", "1 while the tunnel of an enrolled host is up", "host"),
    gauge("rosrv_tunnel_age_seconds", "age of the SA; 0 without an SA", "host"),
    gauge("rosrv_tunnel_bytes", "bytes of the current SA: in (from the host), out", "host", "direction"),
    gauge(
        "rosrv_host_certificate_expiry_seconds",
        "time until a host's certificate expires; negative once expired",
        "host",
    ),
    gauge(
        "rosrv_host_ports_open",
        "1 if a check from outside found ROS ports open, 0 if closed, -1 if not known",
        "host",
    ),
    gauge("rosrv_hosts", "hosts by state, as `rosrv host list` shows it", "state"),
    gauge("rosrv_hosts_blocked", "hosts that operators block (`rosrv host blocks`)"),
    gauge("rosrv_ipsec_troubles", "number of IPsec problems that `rosrv status` reports"),
    gauge("rosrv_audit_queue", "audit records that wait to be written to disk"),
    gauge("rosrv_audit_lag_seconds", "how long the oldest such record has waited"),
    gauge("rosrv_audit_failed", "1 while the audit log cannot be written"),
    gauge(
        "rosrv_audit_degraded",
        "1 while checkpoints, the full-text index or retention are behind, or its disk is nearly full",
    ),
    gauge(
        "rosrv_clock_synchronised",
        "1 while a time service synchronises the machine's clock, 0 while none does, -1 if not known",
    ),
    gauge(
        "rosrv_clock_behind_seconds", "how far the clock is behind the last record, because it was set back"
    ),
    gauge("rosrv_policy_revision", "revision of the policy in force"),
    gauge("rosrv_policy_differs_from_file", "1 while the policy in force differs from its file"),
    counter("rosrv_process_restarts_total", "times a process was started again", "role"),
    gauge("rosrv_process_resident_bytes", "memory of a process", "role"),
    counter("rosrv_rest_calls_total", "REST calls since the api started", "method", "status"),
    *(metric for state in STATES for metric in state.metrics),
)
