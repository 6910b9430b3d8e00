"""The served subscribers of one topic, and the batch that some of them still have to get."""

from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

from appliance.relay.transport.frames import Batch

_ROW = 16  # subscribers between two readings of the processor time


class TopicSubscriber(Protocol):
    """A subscriber, as its topic uses it."""

    host: str

    caller_id: str

    fields: Mapping[str, str]
    """The fields of the subscriber's header."""

    missed: bool
    """Whether the subscriber missed the last message: it was withheld, over a limit, or there was no memory for it."""

    behind_since: float | None
    """When the queue first became so long that the subscriber is behind; None once it has caught up."""

    def greet(self, header: Mapping[str, str]) -> bool:
        """Send the publisher's header; return False if the subscriber has a different type."""

    def admits(self, batch: Batch) -> bool:
        """Whether the subscriber's rate limit and memory let the whole batch pass now."""

    def deliver(self, batch: Batch) -> int:
        """Send or queue the batch; return how many messages are dropped."""

    def accepted(self, batch: Batch, sent: int) -> None:
        """Like `deliver`, after the pump has sent `sent` bytes (negative: the number of an error)."""

    @property
    def descriptor(self) -> int:
        """Return the socket for the next batch, or -1 if a limit or queue needs other work."""

    @property
    def exhausted(self) -> bool:
        """Whether the memory of the subscriber's host is used up."""

    def trim(self) -> int:
        """Return how many messages were dropped."""

    def check_stall(self) -> None:
        """Cut the connection if it makes no progress; called once a second."""

    def cut(self, reason: str) -> None: ...


class ServedSubscribers:
    """The subscribers, in the order in which they came.

    When the publisher's quantum is used up (`over`), the other subscribers get the batch in its next turn, before
    more data is read.
    """

    def __init__(self, over: Callable[[], bool]) -> None:
        self._over = over
        # A dict, not a list: thousands of subscribers may end in one turn, and each removal must be cheap.
        self._members: dict[TopicSubscriber, None] = {}
        self._row: tuple[TopicSubscriber, ...] | None = None
        self._waits: tuple[Batch, tuple[TopicSubscriber, ...]] | None = None
        self.mask: Callable[[str], bool] | None = None
        """Whether messages are withheld from a host, at each delivery."""
        self.dropped = 0
        """The messages that were dropped for slow subscribers since the last report."""

    def withhold(self, mask: Callable[[str], bool] | None) -> None:
        self.mask = mask

    def __len__(self) -> int:
        return len(self._members)

    def __iter__(self) -> Iterator[TopicSubscriber]:
        return iter(self._members)

    @property
    def row(self) -> tuple[TopicSubscriber, ...]:
        if self._row is None:
            self._row = tuple(self._members)
        return self._row

    def add(self, member: TopicSubscriber) -> None:
        self._members[member] = self._row = None

    def remove(self, member: TopicSubscriber) -> None:
        self._members.pop(member, None)
        self._row = None

    @property
    def undelivered(self) -> int:
        return 0 if self._waits is None else len(self._waits[0].view)

    def deliver(self, batch: Batch, member: TopicSubscriber) -> None:
        member.missed = self.mask is not None and self.mask(member.host)
        if not member.missed:
            self.dropped += member.deliver(batch)

    def send(self, batch: Batch, *, divided: bool) -> bool:
        behind = self.hand_out(divided=False)
        self._waits = batch, self.row
        return self.hand_out(divided=divided) or behind

    def go_on_behind(self, batch: Batch, number: int, sent: int) -> bool:
        row = self.row
        self._waits = batch, row[number + 1 :]
        row[number].accepted(batch, sent)
        return self.hand_out(divided=True) or row[number].behind_since is not None

    def hand_out(self, *, divided: bool) -> bool:
        if self._waits is None:
            return False
        (batch, members), self._waits = self._waits, None
        behind = False
        for number, member in enumerate(members):
            if divided and number and not number % _ROW and self._over():
                kept = Batch(batch.keep(), batch.messages, batch.last, owned=True)
                self._waits = kept, members[number:]
                break
            if member in self._members:
                self.deliver(batch, member)
                behind = behind or member.behind_since is not None
        return behind

    def trim(self, *, stalled: bool = False) -> None:
        for member in self.row:
            self.dropped += member.trim()
            if stalled:
                member.check_stall()
