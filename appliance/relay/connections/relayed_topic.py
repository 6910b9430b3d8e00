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
(`published`). What a new publisher says first is kept for those that are on their way (`first_words`).

A latched message that the publisher's host has no memory for is passed on and not kept (`latch`). A later
subscriber gets it from the publisher, which the relay connects to anew when there is room again; the others get it
once more.

When *all* subscribers are behind at the same moment, the publisher is not read until one has caught up, for at
most `queue_grace`: a subscriber process that was descheduled for some milliseconds under a flood loses nothing,
and large messages do not pile up. One that takes longer is slow: what is beyond its bounds is dropped until it
has caught up completely, and it never delays the others, since one that keeps up is never behind.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from appliance.channel.messages import LatchRefused, TopicTraffic
from appliance.recorder.ring import Stream
from appliance.relay.connections.delays import Delays
from appliance.relay.connections.frames import Batch
from appliance.relay.connections.headers import to_subscriber
from appliance.relay.connections.memory import HostShare
from appliance.relay.connections.rate_limit import Part, PublicationFlow
from appliance.relay.connections.startup_replay import APPEARED, FirstWords
from appliance.relay.recorder_ring import LeftOut

_ROW = 16  # subscribers between two readings of the processor time
_SEEN_OF_A_HOST = 16  # subscribers that a publisher may see by name: each is a connection to it more


class Member(Protocol):
    """A subscriber, as its topic sees it."""

    host: str
    """The address it comes from."""

    caller_id: str
    """The caller id that it gives: a claim."""

    missed: bool
    """Whether its limit kept the last message from it."""

    behind_since: float | None
    """When so much waited for it first that it is behind; None once it has caught up completely."""

    def greet(self, header: Mapping[str, str]) -> bool:
        """Answer with the publisher's header, or refuse if the types differ; whether it is served now."""

    def deliver(self, batch: Batch) -> int:
        """Send the batch or queue it; how many messages it does not get."""

    @property
    def full(self) -> bool:
        """Whether its queue has reached its bounds."""

    def trim(self) -> int:
        """Drop what is beyond the bounds, oldest first; how many messages."""

    def look(self) -> None:
        """A second is over."""

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

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        """Others are served now, of a topic of this type; `names` says who when the turn of the loop is over."""

    def give_again(self) -> None:
        """Have a latching publisher give its message again."""


class Recorder(Protocol):
    """The flight recorder, as a topic sees it."""

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> Stream | LeftOut | None:
        """A publisher is connected; None: what it says is not recorded."""


Through = Callable[[Batch], Batch | None]
"""Monitors: the frames that go on, as they leave them; None when none does."""


class RelayedTopic:
    """A topic of an incarnation at `host`, with its subscribers; `share` counts what is kept of it.

    `fresh`: the publisher has just appeared. `limited(part, messages, size)` hears what limits
    dropped; `flow` is where they are set. `make_room(size)` tries to have others give up so much of
    theirs, `refused(message)` is called when a latched message is not kept. `over()`: the publisher's quantum is
    used up; subscribers that have not got a batch by then get it at its next turn, before anything else is read.
    """

    def __init__(
        self,
        key: str,
        topic: str,
        name: str,
        host: str,
        *,
        grace: float,
        clock: Callable[[], float],
        share: HostShare,
        fresh: bool,
        limited: Callable[[Part, int, int], None],
        make_room: Callable[[int], None],
        refused: Callable[[LatchRefused], None],
        recorded: Recorder | None,
        over: Callable[[], bool] = lambda: False,
    ) -> None:
        self.key = key
        self.topic = topic
        self.host = host
        self.name = name
        self.upstream: Upstream | None = None
        self._grace = grace
        self._clock = clock
        self._share = share
        self.flow = PublicationFlow(share, limited)
        self._make_room = make_room
        self._refused = refused
        self._recorder = recorded
        self.over = over
        self._waits: tuple[Batch, tuple[Member, ...]] | None = None  # a batch, and who has yet to get it
        self._recording: Stream | LeftOut | None = None
        self._unkept: LatchRefused | None = None
        self._fresh_until = clock() + (APPEARED if fresh else -1)
        self._header: dict[str, str] | None = None
        # There may be thousands, which end in one turn of the loop: none is looked for.
        self._waiting: dict[Member, None] = {}
        self._served: dict[Member, None] = {}
        self._row: tuple[Member, ...] | None = None  # those that are served, once they are gone through
        self._latched: Batch | None = None
        self._latching = False
        self._withheld = False
        self._first_words: FirstWords | None = None
        self._paused = False
        self._connected = False
        self.through: Through | None = None
        self._looks: tuple[Callable[[Batch], None], ...] = ()
        self._wanted = False
        self._reported = True
        self._next = 1
        self._messages = self._bytes = self._dropped = 0
        self._delays = Delays()

    @property
    def members(self) -> tuple[Member, ...]:
        """All that are connected for this topic."""
        return (*self._waiting, *self._served)

    def join(self, member: Member) -> None:
        """A subscriber with a grant: served at once when the publisher's header is known, else when it is."""
        if self._header is None:
            self._waiting[member] = None
        else:
            self._serve(member, self._header)
        if self.upstream is not None:
            self.upstream.want()

    def leave(self, member: Member) -> None:
        """A subscriber's connection is closed."""
        self._waiting.pop(member, None)
        self._served.pop(member, None)
        self._row = None
        self._announce()
        self._reported = False
        self._forget_header()
        self.relieve()
        self._spare_unwanted()

    @property
    def header(self) -> Mapping[str, str] | None:
        """The publisher's header, as subscribers have it; None while it is not known."""
        return self._header

    def look(self, look: Callable[[Batch], None], *, latched: bool) -> None:
        """Somebody looks at what subscribers get from now on, a `latched` message first; `look` keeps no batch."""
        self._looks += (look,)
        if latched and self._latched is not None:
            look(self._latched)
        if self.upstream is not None:
            self.upstream.want()

    def look_away(self, look: Callable[[Batch], None]) -> None:
        """The look is over."""
        self._looks = tuple(other for other in self._looks if other != look)
        self._spare_unwanted()

    @property
    def _is_wanted(self) -> bool:
        return bool(self._waiting or self._served or self._wanted or self._looks)

    def _spare_unwanted(self) -> None:
        if not self._is_wanted and self.upstream is not None:
            self.upstream.spare()

    def monitor(self, through: Through | None, *, wanted: bool) -> None:
        """From the next batch on messages go `through` monitors (None: past them), who want them or do not."""
        self.through = through
        if wanted == self._wanted:
            return
        self._wanted = wanted
        if self.upstream is None:
            return
        if wanted:
            self.upstream.want()
        self._spare_unwanted()

    def upstream_opened(self, header: Mapping[str, str]) -> None:
        """The publisher has answered with its header."""
        header = to_subscriber(header, self.name, self.topic)
        before, self._header = self._header, header
        self._latching = header.get("latching", "0") == "1"
        self._connected = True
        self._end_recording()
        if self._recorder is not None:
            self._recording = self._recorder.open(self.topic, self.host, header)
        self._listen()
        if before is not None and _identity(before) != _identity(header):
            for member in self._each():
                member.cut("the publisher has come back with another type")
        waiting, self._waiting = self._waiting, {}
        for member in waiting:
            self._serve(member, header)
        self._announce()
        if self._is_wanted and self.upstream is not None:
            self.upstream.want()

    @property
    def lacks_latched(self) -> bool:
        """Whether monitors have kept back what a latching publisher gave, and nothing came through since."""
        return self._latching and self._withheld and self._latched is None

    def upstream_closed(self) -> None:
        """The connection to the publisher is gone; its subscribers stay (see above)."""
        self._end_recording()
        self.hand_out(divided=False)
        self._latch(None)
        self.flow.forget()
        self._withheld = False
        self._paused = False
        self._connected = False
        self._forget_first_words()
        self._forget_header()

    def _end_recording(self) -> None:
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def received(self, batch: Batch, since: float) -> Batch | None:
        """Frames have come from the publisher (`since`: when, by the clock): through the middle, to the subscribers.

        Returns those that monitors leave for the publisher's next turn (`go_on`).
        """
        self._messages += batch.messages
        self._bytes += len(batch.view)
        self._reported = False
        batch.first = self._next
        self._next += batch.messages
        passing: Batch | None = batch
        if self.flow.limits:
            passing = self.flow.passing(batch, self._clock(), latching=self._latching)
        return self._take(batch, passing, since)

    def go_on(self, rest: Batch, since: float) -> Batch | None:
        """Go on with frames that were left for later; as `received`."""
        return self._take(rest, rest, since)

    def _take(self, batch: Batch, passing: Batch | None, since: float) -> Batch | None:
        """Record a batch, of which this passes."""
        recording = self._recording
        if recording is None:
            return None if passing is None else self._admit(passing, since)
        # Recorded when subscribers have it, so that nothing is later; monitors may change it in place meanwhile.
        whole = batch
        if self.through is not None and recording.keeps:
            whole = Batch(memoryview(bytes(batch.view)), batch.messages, batch.last, stride=batch.stride)
            whole.first = batch.first
        passes = 0 if passing is None else passing.messages
        rest = None if passing is None else self._admit(passing, since)
        if recording is self._recording:
            judged = 0 if passing is None else passing.judged
            taken = passes - (0 if rest is None else rest.messages)
            if rest is None:
                taken = whole.messages
            elif passes < whole.messages:  # limits have dropped the others
                dropped = whole.tail(whole.messages - passes)
                recording.write(dropped.view, dropped.messages, dropped.first)
            head = whole if taken == whole.messages else whole.head(taken)
            recording.write(head.view, head.messages, head.first, judged)
        return rest

    def _admit(self, batch: Batch, since: float, *, divided: bool = True) -> Batch | None:
        """Give a batch to monitors and subscribers; returns what monitors had no time for."""
        left = batch if self.through is None else self.through(batch)
        rest = batch.tail(batch.left) if batch.left else None
        if left is None:
            self._withheld = True
        else:
            self._pass_on(left, divided=divided)
            if self._served:
                self._delays.add(self._clock() - since, left.messages)
        return rest

    def published(self, batch: Batch) -> None:
        """A monitor publishes: to the subscribers, and to no monitor."""
        self._messages += batch.messages
        self._bytes += len(batch.view)
        self._reported = False
        if self._recording is not None:
            self._recording.write(batch.view, batch.messages, self._next)
        self._next += batch.messages
        self._pass_on(batch, divided=False)

    def _pass_on(self, batch: Batch, *, divided: bool) -> None:
        for look in self._looks:
            look(batch)
        if self._latching:
            self._latch(batch)
        if self._first_words is not None:
            now = self._clock()
            if self._first_words.over(now) or not self._first_words.add(batch, now):
                self._forget_first_words()
        self.hand_out(divided=False)  # the batch before
        self._waits = batch, self._each()
        self.hand_out(divided=divided)

    @property
    def undelivered(self) -> int:
        """The bytes of a batch that some subscribers get at the publisher's next turn (`hand_out`)."""
        return 0 if self._waits is None else len(self._waits[0].view)

    def hand_out(self, *, divided: bool = True) -> None:
        """Give subscribers the batch that waits for them, for a quantum if the work may be `divided`."""
        if self._waits is None:
            return
        (batch, members), self._waits = self._waits, None
        congested = False
        for number, member in enumerate(members):
            if divided and number and not number % _ROW and self.over():
                kept = Batch(batch.keep(), batch.messages, batch.last, owned=True, stride=batch.stride)
                self._waits = kept, members[number:]
                break
            if member in self._served:
                self._dropped += member.deliver(batch)
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
        self._end_recording()
        for member in self.members:
            member.cut(reason)

    def tidy(self) -> None:
        """A second is over: what was kept for a moment is given up, and what is beyond the share of a subscriber.

        What a limit kept back of a latching publisher goes on when it may.
        """
        now = self._clock()
        waiting = self.flow.later(now)
        if waiting is not None:
            self._admit(waiting, now, divided=False)
        if self._first_words is not None and self._first_words.over(now):
            self._forget_first_words()
        for member in self._each():
            if self._latched is not None and member.missed:
                self._dropped += member.deliver(self._latched)
            if member.full:
                self._dropped += member.trim()
                self._reported = False
            member.look()

    @property
    def latched(self) -> int:
        """The bytes of the latched message that is kept."""
        return 0 if self._latched is None else len(self._latched.view)

    def give_up_latched(self) -> None:
        """Make room for a host that has less."""
        size = self.latched
        self._latch(None)
        self._keep_not(size)

    def repeat(self) -> None:
        """There is a new control: it is told what is not kept."""
        if self._unkept is not None:
            self._refused(self._unkept)

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
        self._served[member] = self._row = None
        self._announce()
        self._reported = False
        if self._latched is not None:
            self._dropped += member.deliver(self._latched)
        elif self._unkept is not None:
            if self.upstream is not None and not self._share.refusal(self._unkept.size):
                self.upstream.give_again()
        elif self._first_words is not None and not self._first_words.over(self._clock()):
            for batch in self._first_words.give(member.caller_id):
                self._dropped += member.deliver(batch)
        self.relieve()

    def _listen(self) -> None:
        """Begin to keep what a publisher says first that has just appeared and has nobody but a monitor."""
        now = self._clock()
        if (
            now <= self._fresh_until
            and self._wanted
            and not self._latching
            and not (self._waiting or self._served)
        ):
            self._first_words = FirstWords(self._share, now)
        self._fresh_until = now - 1  # the next connection is not its first

    def _forget_first_words(self) -> None:
        if self._first_words is not None:
            self._first_words.forget()
            self._first_words = None

    def _forget_header(self) -> None:
        """Without a connection the header is only good for those who have been given it."""
        if not self._connected and not self._served:
            self._header = None

    def _announce(self) -> None:
        """Tell the upstream which subscribers are served."""
        if self.upstream is not None and self._header is not None:
            self.upstream.announce(self._names, self._header.get("type", ""))

    def _names(self) -> frozenset[str]:
        of_host: dict[str, set[str]] = {}
        for member in self._served:
            names = of_host.setdefault(member.host, set())
            if len(names) < _SEEN_OF_A_HOST:
                names.add(member.caller_id)
        return frozenset().union(*of_host.values())

    def _each(self) -> tuple[Member, ...]:
        """Those that are served, however many of them end meanwhile."""
        if self._row is None:
            self._row = tuple(self._served)
        return self._row

    def _latch(self, batch: Batch | None) -> None:
        """Remember the last message of a batch, if its host has the memory for it; None forgets."""
        if self._latched is not None:
            self._share.add(-len(self._latched.view))
            self._latched = None
        if batch is None:
            self._unkept = None
            return
        size = len(batch.view) - batch.find_last()
        if self._share.refusal(size):
            self._make_room(size)
        if self._share.refusal(size):
            self._keep_not(size)
        else:
            self._unkept = None
            self._share.add(size)
            self._latched = batch.keep_last()

    def _keep_not(self, size: int) -> None:
        before, self._unkept = self._unkept, LatchRefused(self.key, self.topic, size)
        if before is None:
            self._refused(self._unkept)

    def _pause_or_trim(self) -> None:
        """Let the subscribers catch up if all are behind and have not been for long; else drop for the full."""
        since = [member.behind_since for member in self._each() if member.behind_since is not None]
        if since and len(since) == len(self._served) and self.upstream is not None:
            left = max(since) + self._grace - self._clock()
            if left > 0:
                self._paused = True
                self.upstream.pause(left)
                return
        for member in self._each():
            if member.full:
                self._dropped += member.trim()


def _identity(header: Mapping[str, str]) -> tuple[str | None, ...]:
    return tuple(header.get(field) for field in ("type", "md5sum", "message_definition", "latching"))
