"""Open the audit log with the limits of the settings."""

from collections.abc import Callable

from appliance.audit.log.budget import Budget, DiskParts, GroupOf
from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.configuration.settings import Settings
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import AUDIT_RESERVE

_HOSTS_IN_RESERVE = AUDIT_RESERVE.bounds.whole // AUDIT_RESERVE.bounds.host


def open_audit(
    settings: Settings,
    signing: SignerRequests,
    held_by: Callable[[list[int]], None],
    *,
    class_of: Callable[[str], QuotaClass],
    group_of: GroupOf,
    receipts: ReceiptFloor,
) -> AuditLog:
    """Open the log. `group_of(host)`: the hosts with which it shares a part of the free disk space. `held_by` gets
    processes that lock it.
    """
    audit = settings.audit
    reserve = AUDIT_RESERVE.bounds.sized(
        int(audit.reserve_bytes), int(audit.reserve_bytes) // _HOSTS_IN_RESERVE
    )
    size = None if audit.retention_bytes is None else int(audit.retention_bytes)
    return AuditLog(
        settings.state / "control" / "audit.db",
        durability=audit.durability,
        checkpoint_every=audit.checkpoint_records,
        checkpoint_seconds=audit.checkpoint_seconds,
        signer=signing.want,
        removals=signing.want_removal,
        held_by=held_by,
        budget=Budget(class_of, reserve=reserve, parts=DiskParts(group_of, size)),
        reserve=reserve.whole,
        retention=Retention(
            days=audit.retention_days,
            size=size,
            collected=receipts.through,
        ),
    )
