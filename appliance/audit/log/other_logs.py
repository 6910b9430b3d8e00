"""Record that the signer signed other logs than the present one, which was therefore replaced or moved away.

Each of them is a record in the present log, with its last signed checkpoint, so the chain goes on. The record is
repeated at each start until an operator sets that log aside.
"""

from collections.abc import Callable, Sequence

from appliance.audit.log.record import AuditRecord, MakeRecord, Severity
from appliance.base.counted import counted
from appliance.signing.signed_logs import OtherLog


class OtherLogs:
    """The other logs that the signer has signed. `hold` receives a record for each change."""

    def __init__(self, make: MakeRecord, hold: Callable[[AuditRecord], None]) -> None:
        self._make = make
        self._hold = hold
        self._missing: dict[str, OtherLog] = {}

    @property
    def missing(self) -> str | None:
        """Return which logs no operator set aside, in words; None if there are none."""
        if not self._missing:
            return None
        names = ", ".join(f"{one.log} (up to checkpoint {one.last})" for one in self._missing.values())
        return (
            f"the audit log was replaced: the signer also signed {counted(len(self._missing), 'other log')}, {names};"
            " rosrv audit verify"
        )

    def named(self, others: Sequence[OtherLog]) -> None:
        before, self._missing = self._missing, {one.log: one for one in others if one.set_aside is None}
        for log, other in self._missing.items():
            if before.get(log) != other:
                reason = "another log took its place, and no operator has set it aside"
                self._note("log replaced", Severity.ALARM, reason, other)
        for other in others:
            if other.set_aside is not None and other.log in before:
                self._note("log set aside", Severity.NOTICE, "by an operator on the machine", other)

    def _note(self, event: str, severity: Severity, reason: str, other: OtherLog) -> None:
        detail = {"log": other.log, "number": other.last, "hash": other.hash}
        self._hold(self._make(event, severity, reason, detail))
