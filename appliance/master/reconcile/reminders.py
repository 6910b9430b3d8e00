"""Send subscribers their lists of publishers again, after a relay started or a topic moved to another relay.

rospy reconnects only for a list that arrives *after* it noticed the broken connection. roscpp reconnects to a port
that stayed open, but after a restart of the appliance it gives up and ignores an unchanged list. So a subscriber that
is still absent after the first reminder gets a list without the publisher, and then one with it. This also helps a
subscriber whose grant was withdrawn and restored without its knowledge.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from appliance.base import clock
from appliance.channel.messages import Message
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.registry import Incarnation, Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.specifications.allocation import TOPIC, Move, Resource

Absent = Callable[[Sequence[Incarnation]], Iterable[tuple[Incarnation, str, Sequence[Incarnation]]]]
Renew = Callable[[Incarnation, str, Sequence[Incarnation]], None]

_GENTLE = 1  # the reminders before a subscriber must drop the publisher and connect again
_LASTING_SECONDS = 5.0
_LONGEST_SECONDS = 600.0
_PAUSES = (0.5, 0.5, 1.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # the seconds before each check


@dataclass(frozen=True, slots=True)
class _Absence:
    """An unconnected subscriber of a topic: the time of its next reminder, and the pause before it."""

    due: float
    pause: float


class Reminders:
    """Reminds absent subscribers, first after `_LASTING_SECONDS`, then at growing intervals.

    `absent` returns those of some nodes, each with the topic and its publishers. `renew` sends a list again, first
    without these publishers.
    """

    def __init__(self, registry: Registry, absent: Absent, renew: Renew) -> None:
        self._registry = registry
        self._absent, self._renew = absent, renew
        self.round: asyncio.Task[None] | None = None
        self._absences: dict[tuple[str, str], _Absence] = {}

    async def run(self) -> None:
        while True:
            await asyncio.sleep(_LASTING_SECONDS)
            self.remind_lasting()

    def remind_lasting(self) -> None:
        before, self._absences, now = self._absences, {}, clock.now()
        for subscriber, topic, publishers in list(self._absent(self._registry.live())):
            absence = before.get((subscriber.key, topic)) or _Absence(
                now + _LASTING_SECONDS, _LASTING_SECONDS
            )
            if now >= absence.due:
                pause = min(2 * absence.pause, _LONGEST_SECONDS)
                absence = _Absence(now + pause, pause)
                self._renew(subscriber, topic, publishers)
            self._absences[subscriber.key, topic] = absence

    def begin(self) -> None:
        self.close()
        self.round = asyncio.get_running_loop().create_task(self._remind())

    def close(self) -> None:
        if self.round is not None:
            self.round.cancel()

    async def _remind(self) -> None:
        for number, pause in enumerate(_PAUSES):
            await asyncio.sleep(pause)
            absent = list(self._absent(self._registry.live()))
            if not absent:
                return
            for subscriber, topic, publishers in absent:
                self._renew(subscriber, topic, publishers if number >= _GENTLE else ())


class RelayMoves:
    """The interface to the relays for specifications.

    A topic moves when a specification connects it with a topic or service of another relay. Until its connections are
    made again, no relay carries it.
    """

    def __init__(self, relay: RelayControl, subscribers: Subscribers, reminders: Reminders) -> None:
        self._relay = relay
        self._subscribers = subscribers
        self._reminders = reminders

    def send(self, message: Message, relay: int) -> bool:
        return self._relay.send(message, relay)

    async def carried_out(self) -> None:
        await self._relay.carried_out()

    def live_resources(self) -> set[Resource]:
        return self._relay.live_resources()

    def withdraw(self, moves: Sequence[Move]) -> None:
        self._relay.withdraw_moving(moves)

    def place(self, moves: Sequence[Move]) -> None:
        self._relay.place_moved(moves)
        for move in moves:
            if move.kind == TOPIC:
                self._subscribers.renew_all(move.name)
        if moves:
            self._reminders.begin()
