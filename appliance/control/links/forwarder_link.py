"""Handle the reports of the audit log's forwarders, for status, metrics and audit records."""

import asyncio
from collections.abc import Callable

import msgspec

from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.link import Link
from appliance.forwarding.forwarding_state import ForwardingState
from appliance.telemetry.audit_trail import AuditTrail

_PATIENCE_SECONDS = 10.0  # a shorter failure, such as the restart of a receiver, is not recorded


class ForwarderLink:
    """The link to a forwarder, and its last report. `received` gets the last sequence that the receiver has."""

    def __init__(
        self,
        to: str | None,
        send: str,
        trail: AuditTrail,
        received: Callable[[int], None] = lambda _sequence: None,
    ) -> None:
        self._to = to
        self._send = send
        self._received = received
        self._trail = trail
        self.link = Link(self._heard)
        self._report: messages.ForwardingReported | None = None
        self._failing: asyncio.TimerHandle | None = None
        self._failure_recorded = False

    def status(self) -> ForwardingState | None:
        if self._to is None:
            return None
        report = self._report or messages.ForwardingReported()
        trouble = report.trouble
        if self.link.channel is None or self._report is None:
            trouble = trouble or "the forwarder is not running yet"
        fields = msgspec.structs.asdict(report) | {"trouble": trouble}
        return ForwardingState(**fields, to=self._to, send=self._send)

    def _heard(self, report: messages.Message) -> None:
        if not isinstance(report, messages.ForwardingReported):
            raise TypeError(f"a forwarder sent a {type(report).__name__}")
        before = self._report
        self._report = report
        self._received(report.sequence)
        if before is not None and report.missed > before.missed:
            count = report.missed - before.missed
            self._trail.happened(
                "forwarding gap",
                f"retention removed {counted(count, 'record')} before {self._to} received them",
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
                    "forwarding resumed", f"{self._to} receives the log again", behind=report.behind
                )

    def _still_failing(self) -> None:
        assert self._report is not None  # noqa: S101  a report started the timer
        self._failure_recorded = True
        self._trail.happened(
            "forwarding failed",
            f"{self._to}: {self._report.trouble}",
            behind=self._report.behind,
            missed=self._report.missed,
        )
