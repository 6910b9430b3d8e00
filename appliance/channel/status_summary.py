"""Summarise control's status for health checks, REST, metrics and `rosrv status`. No I/O."""

from collections.abc import Sequence

from appliance.channel.answers.status import ProcessInfo, Status


def probe_failed(status: Status) -> bool:
    """Return whether the probe failed; False before the first probe."""
    return status.probe not in ("", "passed")


def no_relay(presence: str) -> str | None:
    if presence == "connected":
        return None
    if presence == "away":
        return "no relay process: topics and services carry nothing"
    return f"of the relay processes {presence}: their topics and services carry nothing"


def why_unserved(status: Status) -> str | None:
    if probe_failed(status):
        return f"the ROS master is not hidden: {status.probe}"
    if status.audit.failed and status.audit.on_failure == "deny":
        return f"the audit log cannot be written: {status.audit.failed}"
    relay = no_relay(status.relay)
    if relay is not None:
        return relay
    return None if status.rosmaster == "reachable" else "the ROS master is being rebuilt: calls wait"


def process_names(processes: Sequence[ProcessInfo]) -> list[str]:
    roles = [row.role for row in processes]
    return [
        f"{role} {roles[:place].count(role)}" if roles.count(role) > 1 else role
        for place, role in enumerate(roles)
    ]
