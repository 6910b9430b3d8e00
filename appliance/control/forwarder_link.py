"""Handle the reports of the audit log's forwarder, for status, metrics and audit records."""

import asyncio

import msgspec

from appliance.channel import messages
from appliance.channel.answers.status import ForwardingState
from appliance.channel.link import Link
from appliance.configuration.settings import Syslog
from appliance.telemetry.audit_trail import AuditTrail

_PATIENCE_SECONDS = 10.0  # a shorter failure, such as the restart of a receiver, is not recorded


class ForwarderLink:
    """The link to the forwarder, and its last report. `wanted` is the configuration of the forwarder."""

    def __init__(self, wanted: Syslog, trail: AuditTrail) -> None:
        self._wanted = wanted
        self._trail = trail
        self.link = Link(self._heard)
        self._report: messages.ForwardingReported | None = None
        self._failing: asyncio.TimerHandle | None = None
        self._failure_recorded = False

    def status(self) -> ForwardingState | None:
        """Return the state for `rosrv status` and the metrics, or None if no forwarding is configured."""
        if self._wanted.to is None:
            return None
        report = self._report or messages.ForwardingReported()
        trouble = report.trouble
        if self.link.channel is None or self._report is None:
            trouble = trouble or "the forwarder is not running yet"
        fields = msgspec.structs.asdict(report) | {"trouble": trouble}
        return ForwardingState(**fields, to=self._wanted.to, send=self._wanted.send)

    def _heard(self, report: messages.ForwardingReported) -> None:
        before = self._report
        self._report = report
        if before is not None and report.missed > before.missed:
            count = report.missed - before.missed
            self._trail.happened(
                "forwarding gap",
                f"retention removed {count} records before {self._wanted.to} received them",
                count=count,
            )
        if report.trouble and self._failing is None:
            loop = asyncio.get_running_loop()
            self._failing = loop.call_later(_PATIENCE_SECONDS, self._still_failing)
        elif not report.trouble and self._failing is not None:
            self._failing.cancel()
            self._failing = None
            if self._failure_recorded:
                self._failure_recorded = False
                self._trail.happened(
                    "forwarding resumed", f"{self._wanted.to} receives the log again", behind=report.behind
                )

    def _still_failing(self) -> None:
        assert self._report is not None  # noqa: S101  a report started the timer
        self._failure_recorded = True
        self._trail.happened(
            "forwarding failed",
            f"{self._wanted.to}: {self._report.trouble}",
            behind=self._report.behind,
            missed=self._report.missed,
        )
