"""One relayed topic of one publisher: who gets its messages, without sockets.

A topic has one upstream (the connection to the publisher), subscribers that wait for the publisher's header,
and subscribers that are served. The upstream exists while there is a subscriber, and a short linger beyond.

When the upstream is lost, the subscribers stay: the publication still stands, so its node lives or control
will withdraw it, and then they are cut. Keeping them is what keeps traffic flowing: rospy never connects
again to an address that closed on it (only a `publisherUpdate` makes it), roscpp waits up to 20 s between two
tries; but when the publisher is reached again, messages go on at once for both. Frames are passed on whole
(`frames`), so nobody has been left with a torn one. Only when the publisher comes back with another type or
md5sum are they cut: they must read the new header. A publisher that is killed and restarted is another
incarnation with another key and port; its subscribers are told by control, and the old connections end with
the withdrawal.

A topic that monitors want has its upstream without any subscriber, too. What they leave of a batch (`middle`) is
what subscribers get and what is latched. What monitors publish comes from no upstream and goes past them
(`published`). What comes while nobody is served is kept for a moment (`recent`).

When *all* subscribers are behind at the same moment, the publisher is not read until one has caught up, for at
most `queue_grace`: a subscriber process that was descheduled for some milliseconds under a flood loses nothing,
and large messages do not pile up. One that takes longer is slow: what is beyond its bounds is dropped until it
has caught up completely, and it never delays the others, since one that keeps up is never behind.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from appliance.channel.messages import TopicTraffic
from appliance.relay.delays import Delays
from appliance.relay.frames import Batch, MemoryBudget
from appliance.relay.recent import Recent


class Member(Protocol):
    """A subscriber, as its topic sees it."""

    caller_id: str
    """Who it says it is."""

    behind_since: float | None
    """When so much waited for it first that it is behind; None once it has caught up completely."""

    def greet(self, header: Mapping[str, str]) -> bool:
        """Answer with the publisher's header, or refuse if the types differ; whether it is served now."""

    def deliver(self, batch: Batch) -> None:
        """Send the batch or queue it."""

    @property
    def full(self) -> bool:
        """Whether its queue has reached its bounds."""

    def trim(self) -> int:
        """Drop what is beyond the bounds, oldest first; how many messages."""

    def cut(self, reason: str) -> None:
        """Close its connection."""


class Upstream(Protocol):
    """The connection to the publisher, as its topic sees it."""

    def want(self) -> None:
        """There is somebody to serve."""

    def spare(self) -> None:
        """There is nobody to serve any more."""

    def pause(self, seconds: float) -> None:
        """Do not read until `resume`, or for so long."""

    def resume(self) -> None:
        """Read on."""

    def announce(self, names: frozenset[str], type_name: str) -> None:
        """These are served now, of a topic of this type."""


Through = Callable[[Batch], Batch | None]
"""Monitors: the frames that go on, as they leave them; None when none does."""


class RelayedTopic:
    """A topic of an incarnation with its subscribers."""

    def __init__(
        self,
        key: str,
        topic: str,
        name: str,
        *,
        grace: float,
        clock: Callable[[], float],
        budget: MemoryBudget,
    ) -> None:
        self.key = key
        self.topic = topic
        self.upstream: Upstream | None = None
        self._name = name
        self._grace = grace
        self._clock = clock
        self._budget = budget
        self._header: dict[str, str] | None = None
        self._waiting: tuple[Member, ...] = ()
        self._served: tuple[Member, ...] = ()
        self._latched: Batch | None = None
        self._latching = False
        self._withheld = False
        self._recent: Recent | None = None
        self._paused = False
        self._connected = False
        self._through: Through | None = None
        self._wanted = False
        self._reported = True
        self._messages = self._bytes = self._dropped = 0
        self._delays = Delays()

    @property
    def members(self) -> tuple[Member, ...]:
        """Everybody who is connected for this topic."""
        return self._waiting + self._served

    def join(self, member: Member) -> None:
        """A subscriber with a grant: served at once when the publisher's header is known, else when it is."""
        if self._header is None:
            self._waiting += (member,)
        else:
            self._serve(member, self._header)
        if self.upstream is not None:
            self.upstream.want()

    def leave(self, member: Member) -> None:
        """A subscriber's connection is closed."""
        self._waiting = tuple(one for one in self._waiting if one is not member)
        self._served = tuple(one for one in self._served if one is not member)
        self._announce()
        self._reported = False
        self._forget_header()
        if not self.members:
            self._drop_recent()
            self._settle_recent()
        self.relieve()
        if not self.members and not self._wanted and self.upstream is not None:
            self.upstream.spare()

    def monitor(self, through: Through | None, *, wanted: bool) -> None:
        """From the next batch on messages go `through` monitors (None: past them), who want them or do not."""
        self._through = through
        if wanted == self._wanted:
            return
        self._wanted = wanted
        self._settle_recent()
        if self.upstream is None:
            return
        if wanted:
            self.upstream.want()
        elif not self.members:
            self.upstream.spare()

    def upstream_opened(self, header: Mapping[str, str]) -> None:
        """The publisher has answered with its header."""
        header = {**header, "callerid": self._name, "topic": self.topic}
        before, self._header = self._header, header
        self._latching = header.get("latching", "0") == "1"
        self._connected = True
        self._settle_recent()
        if before is not None and _identity(before) != _identity(header):
            for member in self._served:
                member.cut("the publisher has come back with another type")
        waiting, self._waiting = self._waiting, ()
        for member in waiting:
            self._serve(member, header)
        self._announce()
        if (self.members or self._wanted) and self.upstream is not None:
            self.upstream.want()

    @property
    def lacks_latched(self) -> bool:
        """Whether monitors have kept back what a latching publisher gave, and nothing came through since."""
        return self._latching and self._withheld and self._latched is None

    def upstream_closed(self) -> None:
        """The connection to the publisher is gone; its subscribers stay (see above)."""
        self._latch(None)
        self._withheld = False
        self._paused = False
        self._connected = False
        self._settle_recent()
        self._forget_header()

    def received(self, batch: Batch, since: float) -> None:
        """Frames have come from the publisher (`since`: when, by the clock): through the middle, to the subscribers."""
        self._messages += batch.messages
        self._bytes += len(batch.view)
        self._reported = False
        left = batch if self._through is None else self._through(batch)
        if left is None:
            self._withheld = True
        else:
            self._pass_on(left)
            if self._served:
                self._delays.add(self._clock() - since, left.messages)

    def published(self, batch: Batch) -> None:
        """A monitor publishes: to the subscribers, and to no monitor."""
        self._messages += batch.messages
        self._bytes += len(batch.view)
        self._reported = False
        self._pass_on(batch)

    def _pass_on(self, batch: Batch) -> None:
        if self._latching:
            self._latch(batch.keep_last())
        if self._recent is not None:
            self._remember(self._recent, batch)
        congested = False
        for member in self._served:
            member.deliver(batch)
            congested = congested or member.behind_since is not None
        if congested:
            self._pause_or_trim()

    def relieve(self) -> None:
        """A subscriber has caught up, or is gone, or time is up: the publisher is read."""
        if self._paused:
            self._paused = False
            if self.upstream is not None:
                self.upstream.resume()

    def cut_all(self, reason: str) -> None:
        """The topic is withdrawn: every subscriber's connection is closed."""
        for member in self.members:
            member.cut(reason)

    def tidy(self) -> None:
        """A second is over: what was kept for a moment is given up."""
        if self._recent is not None:
            self._recent.forget_old(self._clock())

    def traffic(self) -> TopicTraffic | None:
        """The counters since the last call; None when nothing has changed."""
        if self._reported:
            return None
        row = TopicTraffic(
            self.key,
            self.topic,
            self._messages,
            self._bytes,
            self._dropped,
            len(self._served),
            *self._delays.take(),
        )
        self._messages = self._bytes = self._dropped = 0
        self._reported = True
        return row

    def _serve(self, member: Member, header: Mapping[str, str]) -> None:
        if not member.greet(header):
            return
        self._served += (member,)
        self._announce()
        self._reported = False
        if self._latched is not None:
            member.deliver(self._latched)
        elif self._recent is not None:
            for batch in self._recent.give(member.caller_id, self._clock()):
                member.deliver(batch)
        self.relieve()

    def _settle_recent(self) -> None:
        """Begin to keep what comes, or stop: there is a publisher that has nobody but a monitor."""
        if self._recent is None:
            if self._connected and self._wanted and not self._latching and not self.members:
                self._recent = Recent(self._budget)
        elif not self._connected or (not self._wanted and not self._served):
            self._drop_recent()

    def _remember(self, recent: Recent, batch: Batch) -> None:
        now = self._clock()
        if recent.over(now):
            self._drop_recent()
        else:
            recent.add(batch, now)

    def _drop_recent(self) -> None:
        if self._recent is not None:
            self._recent.clear()
            self._recent = None

    def _forget_header(self) -> None:
        """Without a connection the header is only good for those who have been given it."""
        if not self._connected and not self._served:
            self._header = None

    def _announce(self) -> None:
        """Tell the upstream who is served."""
        if self.upstream is not None and self._header is not None:
            names = frozenset(member.caller_id for member in self._served)
            self.upstream.announce(names, self._header.get("type", ""))

    def _latch(self, batch: Batch | None) -> None:
        """Remember the last message; it counts as memory in use."""
        if self._latched is not None:
            self._budget.used -= len(self._latched.view)
        if batch is not None:
            self._budget.used += len(batch.view)
        self._latched = batch

    def _pause_or_trim(self) -> None:
        """Let the subscribers catch up if all are behind and have not been for long; else drop for the full."""
        since = [member.behind_since for member in self._served if member.behind_since is not None]
        if since and len(since) == len(self._served) and self.upstream is not None:
            left = max(since) + self._grace - self._clock()
            if left > 0:
                self._paused = True
                self.upstream.pause(left)
                return
        for member in self._served:
            if member.full:
                self._dropped += member.trim()


def _identity(header: Mapping[str, str]) -> tuple[str | None, ...]:
    return tuple(header.get(field) for field in ("type", "md5sum", "message_definition", "latching"))
