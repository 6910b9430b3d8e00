"""Count the frames and refusals of each connection in the last minute, for operators."""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from appliance.base import clock
from appliance.features.doors.door_link import MOST_SHOWN, ClientShown
from appliance.features.doors.session import DoorSession
from appliance.features.doors.viewer_queue import ViewerQueue

SAMPLE_SECONDS = 5
_SAMPLES = 60 // SAMPLE_SECONDS


class _Counts(NamedTuple):
    received: int
    sent: int
    refusals: int


class CountedClient:
    """A connection with its counts. `queues` gets the queue of its protocol once the protocol is known."""

    def __init__(self, session: DoorSession, peer: str, ticket: str, queues: list[ViewerQueue[Any]]) -> None:
        self.session = session
        self.ticket = ticket
        self.peer = peer
        self._since = clock.wall()
        self._queues = queues
        self._samples: deque[_Counts] = deque([_Counts(0, 0, 0)], maxlen=_SAMPLES)

    @property
    def dropped(self) -> int:
        return sum(queue.dropped for queue in self._queues)

    def _counts(self) -> _Counts:
        return _Counts(self.session.received, self.session.sent, self.session.refusals)

    def sample(self) -> None:
        self._samples.append(self._counts())

    def shown(self) -> ClientShown:
        lately = (now - before for now, before in zip(self._counts(), self._samples[0], strict=True))
        return ClientShown(self.peer, self.ticket, self.session.protocol_name, self._since, *lately)


def shown(clients: Iterable[CountedClient]) -> Iterator[ClientShown]:
    oldest_first = sorted((one.shown() for one in clients), key=lambda one: one.since)
    yield from oldest_first[:MOST_SHOWN]
