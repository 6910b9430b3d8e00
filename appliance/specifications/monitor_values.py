"""Ask a relay for the present variables of a monitor, for a reader, and keep its last answer.

A relay is asked at most once in `FRESH_SECONDS` for a monitor, however many readers there are, and only while one asks.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.channel.answers.monitor_answers import MonitorReadout
from appliance.channel.messages import Message, ValuesSeen, ValuesWanted
from appliance.telemetry.audit_trail import AuditTrail

FRESH_SECONDS = 0.25
ANSWER_SECONDS = 1.0
ONE_LOOK = 60.0
"""Queries of a client for a monitor make one audit record until none has come for these seconds."""

_AWAY = "the relay process of this monitor is not running"
_SILENT = f"the relay process did not answer within {ANSWER_SECONDS:g} s"
_ELSEWHERE = "its relay process does not run it yet"


@dataclass(frozen=True, slots=True)
class _Kept:
    seen: ValuesSeen
    at: float
    revision: int


class MonitorValues:
    """Returns the variables of monitors. `send(message, relay)` returns False if that relay is away."""

    def __init__(
        self,
        send: Callable[[Message, int], bool],
        relay_of: Callable[[str], int],
        revision: Callable[[], int],
        trail: AuditTrail,
    ) -> None:
        self._send = send
        self._relay_of = relay_of
        self._revision = revision
        self._trail = trail
        self._number = clock.now_ns()  # relays may outlive control, so no number may be repeated
        self._asked: dict[str, tuple[tuple[int, int], asyncio.Future[str]]] = {}
        """The relay that is asked about a monitor, the number, and the answer."""
        self._kept: dict[str, _Kept] = {}
        self._shown: dict[tuple[str, str], float] = {}

    async def of(self, monitor: str, who: str) -> MonitorReadout:
        self._record(monitor, who)
        self._kept = {name: one for name, one in self._kept.items() if one.revision == self._revision()}
        kept = self._kept.get(monitor)
        why = ""
        if kept is None or clock.now() - kept.at > FRESH_SECONDS:
            why = await self._ask(monitor)
            kept = self._kept.get(monitor)
        if kept is None:
            return MonitorReadout(monitor, {}, {}, None, why or _ELSEWHERE)
        age = max(0.0, clock.now() - kept.at)
        ages = {event: None if past is None else past + age for event, past in kept.seen.ages.items()}
        now = None if kept.seen.now_ns is None else kept.seen.now_ns / 1e9 + age
        return MonitorReadout(monitor, kept.seen.values or {}, ages, age, why, now)

    async def _ask(self, monitor: str) -> str:
        """Ask the relay, or join a query that waits for its answer. Return why there is no answer, or an empty text."""
        if monitor not in self._asked:
            self._number += 1
            relay = self._relay_of(monitor)
            if not self._send(ValuesWanted(self._number, monitor), relay):
                return _AWAY
            self._asked[monitor] = (relay, self._number), asyncio.get_running_loop().create_future()
        asked, answer = self._asked[monitor]
        try:
            async with asyncio.timeout(ANSWER_SECONDS):
                return await asyncio.shield(answer)
        except TimeoutError:
            if self._asked.get(monitor, ((0, 0), None))[0] == asked:
                del self._asked[monitor]
            return _SILENT

    def received(self, seen: ValuesSeen, relay: int) -> None:
        for monitor, (asked, answer) in list(self._asked.items()):
            if asked == (relay, seen.number):
                del self._asked[monitor]
                if seen.values is not None:
                    self._kept[monitor] = _Kept(seen, clock.now(), self._revision())
                answer.set_result("" if seen.values is not None else _ELSEWHERE)

    def relay_lost(self, relay: int) -> None:
        """Answer the readers that wait for it."""
        for monitor, (asked, answer) in list(self._asked.items()):
            if asked[0] == relay:
                del self._asked[monitor]
                answer.set_result(_AWAY)

    def _record(self, monitor: str, who: str) -> None:
        now = clock.now()
        self._shown = {look: at for look, at in self._shown.items() if now - at < ONE_LOOK}
        begun = (who, monitor) not in self._shown
        self._shown[who, monitor] = now
        if begun:
            self._trail.happened(
                "monitor looked into",
                f"variables of {monitor} are shown from now on, until no query has come for {ONE_LOOK:g} seconds",
                category="monitor",
                resource=monitor,
                who=who,
            )
