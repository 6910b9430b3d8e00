"""One relayed topic of one publisher: its subscribers and the messages that they get, without sockets.

Subscribers stay connected when the upstream is lost, until control withdraws the publication: rospy never reconnects
to an address that closed its connection, and roscpp waits up to 20 s. They are cut only if the publisher returns with
another header (`_identity`), which they must read.

A guard's stop comes over another connection, so it can overtake motions that wait in this publisher's connection, in
the queue or in the kernel. Therefore subscribers also get the stop after these motions, and a later subscriber gets
it instead of them (`supersede`).

A latching publisher sends its last message again on each connection, roscpp that of each `ros::Publisher`. On a topic
of commands these messages are not new, so only stops among them pass (`replayed`), except on the first connection of a
new publisher.

A publisher may greet each new subscriber with a message, from its connect callback (costmap_2d). For a later subscriber
of a topic that is quiet, the relay opens an extra connection for up to two seconds, and passes what comes to the
newcomers alone, through monitors. It does so at most once a second, and once a minute if no greeting came twice in a
row; a newcomer that got nothing has a part in the second request. A topic that sends within that time does not greet. A
command (a message of a topic that had a guard, or a goal) is never requested in this way: it would begin a motion long
after it was sent.

roscpp latches a message of each `ros::Publisher` of a topic. The relay keeps the last one, which a later subscriber
gets at once. If the publisher has sent more than the kept message on this connection, the subscriber gets the others
over an extra connection. Monitors do not judge them again, because an older message could then undo a newer one of
another `ros::Publisher`: those that passed unchanged when they came pass, and no others. In this way, a subscriber also
gets a message that was not kept because its publisher's host had no memory left.

Messages of a topic with a rank pass while their publisher is heard (`give_rank`). A message that was taken before a
hand-over, and waits for monitors, does not pass after it; nor does a latched one.

While *all* subscribers are behind, the relay stops reading the publisher for at most `queue_grace`, so a subscriber
that the scheduler paused for some milliseconds loses nothing.
"""

import hashlib
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from appliance.channel.messages import LatchRefused, TopicTraffic
from appliance.relay.connections.headers import to_subscriber
from appliance.relay.connections.message_sink import MessageSink, MessageStream
from appliance.relay.connections.named_subscribers import seen_names
from appliance.relay.connections.ranked_publication import RankedPublication
from appliance.relay.connections.served_subscribers import ServedSubscribers, TopicSubscriber
from appliance.relay.connections.startup_replay import APPEARED, LatchReplay, StartupReplay
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HostMemory
from appliance.relay.transport.pump import SUBSCRIBERS, ModuleCall, Traffic, Version, walk
from appliance.relay.transport.rate_limit import Part, PublicationRateLimit, RateAllowance
from roswire.tcpros import encode_frame

_QUIET_SECONDS = 1.0  # without a message before a publisher is asked for a greeting
_UNGREETED_SECONDS = 60.0  # between two requests to a publisher that does not greet
_REPLAYS = 64  # most latched commands of one read that are judged, the last ones
_PASSED = 200  # most digests of messages that monitors passed

Through = Callable[[Batch], Batch | None]
"""Passes frames through monitors, and returns the frames that may pass, or None."""

Tap = Callable[[Batch], None]

# The last message of a latching publisher, kept in the memory of the publisher's host.


class LatchedMessage:
    """The message that late subscribers of one topic get, or none; `share` counts its memory.

    `refused(size)` is called for the first message that is not kept.
    """

    def __init__(
        self, share: HostMemory, make_room: Callable[[int], None], refused: Callable[[int], None]
    ) -> None:
        self._share = share
        self._make_room = make_room
        self._refused = refused
        self._refused_size: int | None = None
        self._passed: dict[bytes, None] = {}
        self.batch: Batch | None = None
        self.is_latching = False
        self.withheld = False
        """Whether monitors have held back the last message of this publisher."""

    @property
    def size(self) -> int:
        return 0 if self.batch is None else len(self.batch.view)

    @property
    def is_lacking(self) -> bool:
        return self.is_latching and self.withheld

    def judge(self, batch: Batch, through: Through) -> Batch | None:
        """Pass one message through monitors, and note whether they leave it unchanged."""
        digest = _digest(batch.view)
        left = through(batch)
        self._passed.pop(digest, None)
        if left is not None and _digest(left.view) == digest:
            self._passed[digest] = None
            if len(self._passed) > _PASSED:
                del self._passed[next(iter(self._passed))]
        return left

    def others(self, frames: bytes, *, judged: bool) -> Batch | None:
        """Return the frames besides the kept message; if `judged`, only those that monitors have left unchanged."""
        kept = b"" if self.batch is None else bytes(self.batch.view)
        others: list[memoryview] = []
        for frame in Batch(memoryview(frames), 0, None).frames():
            if kept and len(frame) == len(kept) and bytes(frame) == kept:
                kept = b""
            elif not judged or _digest(frame) in self._passed:
                others.append(frame)
        return Batch(memoryview(b"".join(others)), len(others), None, owned=True) if others else None

    def keep(self, batch: Batch) -> None:
        self.withheld = False
        self._free()
        size = len(batch.view) - batch.find_last()
        if self._share.refusal(size):
            self._make_room(size)
        if self._share.refusal(size):
            self._refuse(size)
        else:
            self._refused_size = None
            self._share.add(size)
            self.batch = batch.keep_last()

    def forget(self) -> None:
        self._free()
        self._refused_size = None
        self.withheld = False

    def give_up(self) -> None:
        size = self.size
        self._free()
        self._refuse(size)

    def repeat(self) -> None:
        if self._refused_size is not None:
            self._refused(self._refused_size)

    def _free(self) -> None:
        if self.batch is not None:
            self._share.add(-len(self.batch.view))
            self.batch = None

    def _refuse(self, size: int) -> None:
        before, self._refused_size = self._refused_size, size
        if before is None:
            self._refused(size)


class Newcomers:
    """The `members` that may need a greeting, each with the number of the next message when it came."""

    def __init__(self) -> None:
        self.reset(1, is_latching=False)

    def reset(self, following: int, *, is_latching: bool) -> None:
        """Begin with a connection that brings the message number `following` first."""
        self.members: dict[TopicSubscriber | Tap, int] = {}
        self.first = following
        self._is_latching = is_latching
        self._heard = 0, 0.0  # the number of the next message, and since when it has been that
        self._not_before = 0.0
        self._ungreeted = 0  # requests in a row without a greeting

    def heard(self, following: int, now: float) -> None:
        if following != self._heard[0]:
            self._heard = following, now

    def due(self, following: int, now: float) -> bool:
        passed, since = self._heard
        is_quiet = self._is_latching or (following == passed and now >= since + _QUIET_SECONDS)
        return bool(self.members) and is_quiet and now >= self._not_before

    def take(self, following: int, now: float) -> Collection[TopicSubscriber | Tap]:
        """Return the members that lack a greeting; none is due until `asked`.

        A message that came after a member is its greeting, unless the publisher latches several messages.
        """
        lacking = (
            member for member, first in self.members.items() if self._is_latching or first == following
        )
        self.members = dict.fromkeys(lacking, following)
        if self.members:
            self._not_before = now + _UNGREETED_SECONDS
        return tuple(self.members)

    def asked(self, members: Collection[TopicSubscriber | Tap], now: float, *, greeted: bool) -> None:
        self._ungreeted = 0 if greeted else self._ungreeted + 1
        again = self._ungreeted < 2
        self._not_before = now + (_QUIET_SECONDS if again or self._is_latching else _UNGREETED_SECONDS)
        for member in members if greeted or not again else ():
            self.members.pop(member, None)

    def wait_on(self, following: int, now: float) -> None:
        """Let those who came during a greeting wait for the next one."""
        self._heard = following, now
        self.members = dict.fromkeys(self.members, following)


class Silence:
    """The silence of a publication, if its host loses a right by it (`watched`)."""

    def __init__(self) -> None:
        self.watched = False
        self._since = 0.0  # the time of the last report, or since when the publication has been open

    def begin(self, now: float) -> None:
        self._since = now

    def take(self, now: float, *, is_open: bool) -> float:
        """Return the seconds since the last report in which a message would have been heard."""
        since, self._since = self._since, now
        return now - since if self.watched and is_open else 0.0


class Upstream:
    """The connection to the publisher, as its topic uses it. The methods of this base class do nothing."""

    def connect(self) -> None:
        """Connect, because the topic is wanted."""

    def release(self) -> None:
        """Close the connection, because the topic is no longer wanted."""

    def pause(self, seconds: float) -> None:
        """Stop reading until `resume`, for at most this time."""

    def resume(self) -> None: ...

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        """Report new subscribers; `names` is called after this turn of the loop."""

    def greet(self, greeted: Callable[[bytes], None]) -> None:
        """Call `greeted` with the frames of one more connection, unless the upstream is lost before."""

    def request_latched(self) -> None:
        """Make a latching publisher send its message again."""

    def ask_again(self) -> None:
        """Repeat an open question to a new control."""

    def found(self, host: str, port: int) -> None:
        """Connect to this address; ignore an answer that is no longer awaited."""

    def refused(self) -> None:
        """Ask again later, because control has no address."""

    def recheck(self) -> None:
        """Apply the specifications that are in force now."""

    def silence(self, *, silent: bool) -> None:
        """If `silent`, close the connection at once and take no message; otherwise connect if the topic is wanted."""

    def check_stall(self) -> None:
        """Disconnect a publisher that stalls in the middle of a message."""

    def close(self) -> None:
        """Close everything, because the publication is withdrawn."""


def _no_call() -> ModuleCall | None:
    return None


class TopicState(Enum):
    """The state of a publisher. LOST: its connection is closed, and served subscribers have read its header."""

    UNKNOWN = auto()
    OPEN = auto()
    LOST = auto()


@dataclass(frozen=True, slots=True)
class _Monitoring:
    """How a topic's messages pass monitors (`through` is None: past them), and whether monitors need the topic."""

    through: Through | None = None
    call: Callable[[], ModuleCall | None] = _no_call
    wanted: bool = False


class Delays:
    """How late messages of a topic were written, since the last `take`. `judged` is whether monitors judge them."""

    def __init__(self, late: float) -> None:
        self._late = late  # seconds
        self._waited, self._told = 0.0, 0
        self.judged = False

    def waited(self, seconds: float) -> None:
        """Note that messages waited in the publisher's socket because the relay served others."""
        self._waited = max(self._waited, seconds)

    def take(self, counters: Traffic) -> tuple[int, float]:
        late, self._told = counters.late - self._told, counters.late
        waited, self._waited = self._waited, 0.0
        return late + (waited > self._late), max(counters.longest / 1e9, waited)


class RelayedTopic:
    """A topic of an incarnation at `host`, with its subscribers; `share` counts the memory of its kept messages.

    The upstream stays open while a subscriber, a monitor or a tap needs it, and a little longer in a reload or
    restart.
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
        share: HostMemory,
        fresh: bool,
        late: float = math.inf,
        limited: Callable[[Part, int, int], None],
        make_room: Callable[[int], None],
        refused: Callable[[LatchRefused], None],
        sink: MessageSink | None,
        replayed: Callable[["RelayedTopic", memoryview], bool] = lambda _topic, _body: True,
        over: Callable[[], bool] = lambda: False,
        servers: Callable[[str], Collection[str]] = lambda _topic: (),
    ) -> None:
        self._servers = servers
        self.key = key
        self.topic = topic
        self.host = host
        self.name = name
        self.upstream = Upstream()
        self._grace = grace
        self._clock = clock
        self._sink = sink
        self.flow = PublicationRateLimit(share, limited)
        self.plain = Version()
        """Changes whenever the pump may have to leave the next frames to Python (see `simple`)."""
        self.counters = Traffic(late)
        self.delays = Delays(late)
        self.latch = LatchedMessage(share, make_room, lambda size: refused(LatchRefused(key, topic, size)))
        self._served = ServedSubscribers(over)
        self._state = TopicState.UNKNOWN
        self._header: dict[str, str] | None = None  # as subscribers get it; None while UNKNOWN
        self._waiting: dict[TopicSubscriber, None] = {}
        self._monitoring = _Monitoring()
        self._taps: tuple[Tap, ...] = ()
        self._stream: MessageStream | None = None
        self._replayed = replayed
        new_until = clock() + (APPEARED if fresh else -1)
        self._latch_replay = LatchReplay(new_until)
        self._startup_replay = StartupReplay(share, new_until)
        self._reported = True
        self._superseded = False  # whether a guard's stop is the last message
        self._is_command = topic.endswith("/goal")  # no monitor can declare what stops an action
        self._rank: RankedPublication | None = None
        self._silence = Silence()
        self._newcomers = Newcomers()

    @property
    def point(self) -> ObservationPoint:
        """Where monitors observe its messages."""
        return ObservationPoint(self.key, self.topic, self.host, self.name)

    @property
    def members(self) -> tuple[TopicSubscriber, ...]:
        return (*self._waiting, *self._served)

    def join(self, member: TopicSubscriber) -> None:
        if self._header is None:
            self._waiting[member] = None
        elif not self._serve(member, self._header):
            self._newcomers.members[member] = self.counters.following
            self._greet()
        self.upstream.connect()

    def leave(self, member: TopicSubscriber) -> None:
        self._waiting.pop(member, None)
        self._newcomers.members.pop(member, None)
        self._served.remove(member)
        self.differs()
        self.announce()
        self._reported = False
        self._forget_header()
        self.relieve()
        self._spare_unwanted()

    @property
    def header(self) -> Mapping[str, str] | None:
        return self._header

    def tap(self, tap: Tap, *, latched: bool) -> None:
        """Call `tap` with each batch, first (if `latched`) with latched messages. The tap must not keep a batch."""
        self._taps += (tap,)
        self.differs()
        if latched and self.latch.batch is not None:
            tap(self.latch.batch)
        if latched and self._latches_others:
            self._newcomers.members[tap] = self.counters.following
            self._greet()
        self.upstream.connect()

    def untap(self, tap: Tap) -> None:
        self._taps = tuple(other for other in self._taps if other != tap)
        self._newcomers.members.pop(tap, None)
        self.differs()
        self._spare_unwanted()

    def differs(self) -> None:
        self.plain.change()

    def simple(self) -> tuple[list[int], ModuleCall | None] | None:
        """Return the subscribers' descriptors and the monitors' call if the next small frames need no other work.

        The answer holds until `plain` or the monitors' preparation changes.
        """
        if self.latch.is_latching or self._taps or self.flow.limits or len(self._served) > SUBSCRIBERS:
            return None
        if self._served.mask is not None or self._superseded or self._rank is not None:
            return None
        if self._stream is not None or self._startup_replay.keeps or self._served.undelivered:
            return None
        call = None
        if self._monitoring.through is not None:
            call = self._monitoring.call()
            if call is None:
                return None
        descriptors = [member.descriptor for member in self._served.row]
        return None if -1 in descriptors else (descriptors, call)

    @property
    def keeps_large(self) -> bool:
        return not any(member.exhausted for member in self._served)

    def limit(self, own: RateAllowance | None, together: RateAllowance | None) -> None:
        self.flow.set(own, together)
        self.differs()

    @property
    def _is_wanted(self) -> bool:
        if self._silence.watched or self._rank is not None:  # its motions count even without a subscriber
            return True
        return bool(self._waiting or self._served or self._monitoring.wanted or self._taps)

    def keep_open(self, *, kept: bool) -> None:
        """Stay connected without a subscriber, and report silence, if `kept`."""
        if kept != self._silence.watched:
            self._silence.watched = kept
            if kept:
                self.upstream.connect()
            self._spare_unwanted()

    def _spare_unwanted(self) -> None:
        if not self._is_wanted:
            self.upstream.release()

    def monitor(
        self,
        through: Through | None,
        *,
        wanted: bool,
        call: Callable[[], ModuleCall | None] = _no_call,
        guarded: bool = False,
    ) -> None:
        """Pass messages `through` monitors from the next batch on (None: bypass them).

        With `wanted`, the topic stays connected even without a subscriber. `call` returns the call of the
        compiled module, if any. A topic that once was `guarded` counts as one of commands, even when the guard is off.
        """
        self._is_command |= guarded
        before, self._monitoring = self._monitoring, _Monitoring(through, call, wanted)
        self.delays.judged = through is not None
        self.differs()
        if wanted == before.wanted:
            return
        if wanted:
            self.upstream.connect()
        self._spare_unwanted()

    def give_rank(self, rank: RankedPublication | None) -> None:
        """Pass only messages that the `rank` passes, from the next batch on. Such a topic carries commands."""
        if rank is None and self._rank is None:
            return
        self._rank = rank
        self.differs()
        if rank is None:
            self._spare_unwanted()
            return
        self._is_command = True
        if self._header is not None and self._state is TopicState.OPEN:
            rank.opened(self._header, self._clock())
        self.hush()
        self.upstream.connect()

    def hush(self) -> None:
        """Discard the latched and startup messages, because another publisher of the topic now drives; read on."""
        self._startup_replay.forget()
        if not self._superseded:
            self.latch.forget()
        self.differs()
        self.relieve()

    def withhold(self, mask: Callable[[str], bool] | None) -> None:
        """Withhold messages from each host for which `mask` is true at their delivery.

        The latched message is the present value of the topic: a host gets it once the topic is withheld no longer.
        """
        self._served.withhold(mask)
        self.differs()

    def upstream_opened(self, header: Mapping[str, str]) -> None:
        header = to_subscriber(header, self.name, self.topic)
        before, self._header = self._header, header
        self.latch.is_latching = header.get("latching", "0") == "1"
        self._state = TopicState.OPEN
        self._silence.begin(self._clock())
        self._newcomers.reset(self.counters.following, is_latching=self.latch.is_latching)
        if self._rank is not None:
            self._rank.opened(header, self._clock())
        # With a rank, a latched message may be older than a hand-back.
        may_be_new = self._rank is None
        self._latch_replay.opened(self._clock(), is_latching=self.latch.is_latching, may_be_new=may_be_new)
        self.differs()
        self._end_stream()
        if self._sink is not None:
            self._stream = self._sink.open(self.topic, self.host, header)
        watched = self._monitoring.wanted or self._silence.watched or self._rank is not None
        alone = watched and not (self.latch.is_latching or self._waiting or self._served)
        self._startup_replay.opened(self._clock(), alone=alone)
        if before is not None and _identity(before) != _identity(header):
            self._forget_stop()
            for member in self._served.row:
                member.cut("the publisher returned with a different type")
        waiting, self._waiting = self._waiting, {}
        for member in waiting:
            self._serve(member, header)
        self.announce()
        if self._is_wanted:
            self.upstream.connect()

    @property
    def lacks_latched(self) -> bool:
        return self.latch.is_lacking and not self._is_command

    def judge_latched(self) -> None:
        """Let monitors that have come into force judge the kept message, which its publisher sends only once.

        Subscribers have it; later ones get what the monitors leave. A command is forgotten: it is not new.
        """
        kept, through = self.latch.batch, self._monitoring.through
        if kept is None or through is None or self._superseded:
            return
        if self._is_command:
            self.latch.forget()
            return
        if self._state is not TopicState.OPEN:  # its publisher sends it again when it returns
            return
        one = Batch(memoryview(bytearray(kept.view)), 1, 0, owned=True)
        one.first = self.counters.following - 1
        left = self.latch.judge(one, through)
        if left is not None:
            self.latch.keep(left)
        else:
            self.latch.forget()
            self.latch.withheld = True

    def upstream_closed(self, *, repeats: bool = False) -> None:
        """Note a lost connection. Keep the last message that passed if the publisher `repeats` it when it returns."""
        if self._rank is not None:
            self._rank.closed(self._clock())
        self._end_stream()
        self.hand_out(divided=False)
        if not self._superseded and not (repeats and self.latch.batch is not None):
            self.latch.forget()
        self.flow.forget()
        self._state = TopicState.LOST
        self._startup_replay.forget()
        self._forget_header()

    def _end_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None
            self.differs()

    def received(self, batch: Batch, since: float) -> Batch | None:
        """Pass frames on, and return those that monitors leave for the publisher's next turn (`go_on`)."""
        batch.first = self.counters.following
        self.counters.add(batch.messages, len(batch.view))
        self._reported = False
        if self._latch_replay.is_replay(self._clock()) and self._is_command:
            self._pass_stops(batch, since)
            return None
        return self._receive(batch, since)

    def _pass_stops(self, batch: Batch, since: float) -> None:
        """Pass only stops of commands that the publisher had latched before, one by one: others may lie between."""
        early = batch.head(max(0, batch.messages - _REPLAYS))
        if early.messages:
            self.latch.withheld = True
            if self._stream is not None:
                self._stream.write(early.view, early.messages, early.first, carried=False)
        for number, frame in enumerate(batch.frames(early.messages), batch.first + early.messages):
            one = Batch(memoryview(bytearray(frame)), 1, 0, owned=True)
            one.first = number
            if self._replayed(self, one.view[4:]):
                self._receive(one, since)
                continue
            self.latch.withheld = True
            if self._stream is not None:
                self._stream.write(one.view, 1, one.first, carried=False)

    def _receive(self, batch: Batch, since: float) -> Batch | None:
        passing = batch
        if self._rank is not None:
            passing = self._rank.passing(batch, self._clock())
        if passing is not batch:
            if self._stream is not None:
                dropped = batch.head(batch.messages - passing.messages)
                self._stream.write(dropped.view, dropped.messages, dropped.first, carried=False)
            if not passing.messages:
                return None
            batch = passing
        if self.flow.limits:
            latching = (
                self.latch.is_latching and self._rank is None
            )  # a delayed message could be older than a hand-back
            passing = self.flow.passing(passing, self._clock(), latching=latching)
        return self._take(batch, passing, since)

    def sent(self, batch: Batch, since: float, number: int, sent: int) -> None:
        """Continue after the pump has passed a batch to the first `number` subscribers, and `sent` bytes to the next.

        If `sent` is negative, it is the number of an error.
        """
        self.counters.add(batch.messages, len(batch.view))
        self._reported = False
        if self._served.go_on_behind(batch, number, sent):
            self._pause_or_trim()
        self.counters.delayed(self._clock() - since, batch.messages)

    def go_on(self, rest: Batch, since: float) -> Batch | None:
        self._reported = False
        if self._rank is not None and not self._rank.hears(self._clock()):
            return self._take(rest, Batch(rest.view[:0], 0, None), since)
        return self._take(rest, rest, since)

    def _take(self, batch: Batch, passing: Batch, since: float) -> Batch | None:
        # Write after subscribers got the batch, to delay nothing; copy it first: monitors may change it in place.
        stream, whole = self._stream, batch
        if stream is not None and stream.keeps and self._monitoring.through is not None:
            whole = Batch(memoryview(bytes(batch.view)), batch.messages, batch.last)
            whole.first = batch.first
        rest = self._admit(passing, since) if passing.messages else None
        if stream is not None and stream is self._stream:
            taken = passing.messages - (0 if rest is None else rest.messages)
            if taken:
                head = whole if taken == whole.messages else whole.head(taken)
                stream.write(head.view, taken, head.first, passing.judged)
            if passing.messages < whole.messages:  # limits or a rank have dropped the others
                dropped = whole.tail(whole.messages - passing.messages)
                stream.write(dropped.view, dropped.messages, dropped.first, carried=False)
        return rest

    def _admit(self, batch: Batch, since: float, *, divided: bool = True) -> Batch | None:
        through = self._monitoring.through
        # A message may withhold the next one, and the last one may be held back.
        alone = self._served.mask is not None or (self.latch.is_latching and through is not None)
        if alone and batch.messages > 1:
            first = batch.head(1)
            self._admit(first, since, divided=False)
            batch.judged = first.judged
            return batch.tail(batch.messages - 1)
        if through is None:
            left: Batch | None = batch
        elif self.latch.is_latching and not self._is_command:
            left = self.latch.judge(batch, through)
        else:
            left = through(batch)
        rest = batch.tail(batch.left) if batch.left else None
        if left is None:
            self.latch.withheld = True
        else:
            self._pass_on(left, divided=divided)
            if self._served:
                self.counters.delayed(self._clock() - since, left.messages)
        return rest

    def published(self, batch: Batch) -> None:
        first = self.counters.following
        self.counters.add(batch.messages, len(batch.view))
        self._reported = False
        if self._stream is not None:
            self._stream.write(batch.view, batch.messages, first)
        self._pass_on(batch, divided=False)

    def supersede(self, data: bytes | None) -> None:
        """Send a guard's stop after all messages of this publisher, and repeat none of them to later subscribers.

        If `data` is None, send nothing: a monitor has published another command.
        """
        self._startup_replay.forget()
        if data is None or self._header is None:
            self._forget_stop()
        elif not self._superseded:
            self._superseded = True
            stop = Batch(memoryview(encode_frame(data)), 1, 0, owned=True)
            self.latch.keep(stop)
            self.differs()
            if self._served.send(stop, divided=False):
                self._pause_or_trim()

    def _forget_stop(self) -> None:
        self._superseded = False
        self.latch.forget()
        self.differs()

    def _pass_on(self, batch: Batch, *, divided: bool) -> None:
        for tap in self._taps:
            tap(batch)
        if self._superseded:
            self._forget_stop()
        if self.latch.is_latching:
            self.latch.keep(batch)
        if self._startup_replay.keeps:
            self._startup_replay.add(batch, self._clock())
        if self._served.send(batch, divided=divided and self._served.mask is None):
            self._pause_or_trim()

    @property
    def undelivered(self) -> int:
        return self._served.undelivered

    def hand_out(self, *, divided: bool = True) -> None:
        if self._served.hand_out(divided=divided):
            self._pause_or_trim()

    def relieve(self) -> None:
        self.upstream.resume()

    def cut_all(self, reason: str) -> None:
        self._end_stream()
        for member in self.members:
            member.cut(reason)

    def tidy(self) -> None:
        now = self._clock()
        waiting = self.flow.later(now)
        if waiting is not None and self._rank is None:
            self._admit(waiting, now, divided=False)
        self._startup_replay.expire(now)
        if self.latch.batch is not None:
            # Only a subscriber's first refusal is counted.
            late = [one for one in self._served.row if one.missed and one.admits(self.latch.batch)]
            for member in late:
                self._served.deliver(self.latch.batch, member)
                if self._latches_others and not member.missed:
                    self._newcomers.members[member] = self.counters.following
        self._served.trim(stalled=True)
        self._newcomers.heard(self.counters.following, now)
        self._greet()
        self.upstream.check_stall()

    @property
    def _latches_others(self) -> bool:
        """Whether the publisher may have latched other messages than the kept one."""
        return self.latch.is_latching and (
            self.counters.following - self._newcomers.first > (self.latch.batch is not None)
        )

    @property
    def _may_greet(self) -> bool:
        if self._is_command or self._superseded or self._rank is not None:
            return False
        return self._state is TopicState.OPEN and not self.flow.limits

    def _greet(self) -> None:
        """Ask for a greeting of the served newcomers that lack one."""
        following = self.counters.following
        if not self._newcomers.due(following, self._clock()):
            return
        if not self._may_greet:
            self._newcomers.members.clear()
        elif members := self._newcomers.take(following, self._clock()):
            self.upstream.greet(lambda frames: self._on_greeting(members, following, frames))

    def _on_greeting(self, members: Collection[TopicSubscriber | Tap], before: int, frames: bytes) -> None:
        is_stream = self.counters.following != before  # a message for all, which came over both connections
        is_latching = self.latch.is_latching
        # A newer message of a `ros::Publisher` may have overtaken its latched one.
        greeted = bool(frames) and not is_stream if is_latching else bool(frames) or is_stream
        self._newcomers.asked(members, self._clock(), greeted=greeted)
        if is_stream or not frames or not self._may_greet:
            return
        if is_latching:
            passing = self.latch.others(frames, judged=self._monitoring.through is not None)
        else:
            passing = self._greeting_passing(frames, before)
        if passing is None:
            return
        for member in self._served.row:
            if member in members and (not is_latching or member.admits(passing)):
                self._served.deliver(passing, member)
        for tap in self._taps:
            if tap in members:
                tap(passing)

    def _greeting_passing(self, frames: bytes, before: int) -> Batch | None:
        batch = Batch(memoryview(frames), walk(memoryview(frames))[1], None, owned=True)
        batch.first = before
        self.counters.add(batch.messages, len(frames))
        self._reported = False
        self._newcomers.wait_on(self.counters.following, self._clock())
        if self._stream is not None:
            self._stream.write(batch.view, batch.messages, before)
        through = self._monitoring.through
        return batch if through is None else through(batch)

    def take_late(self) -> tuple[int, float]:
        """Return the late messages since the last call, and the longest delay or wait in seconds."""
        return self.delays.take(self.counters)

    def traffic(self) -> TopicTraffic | None:
        silent = self._silence.take(self._clock(), is_open=self._state is TopicState.OPEN)
        if self._reported and not self.counters.messages and not self._served.dropped and not silent:
            return None
        messages, size, counts, seconds = self.counters.take()
        dropped, self._served.dropped = self._served.dropped, 0
        row = TopicTraffic(
            self.key,
            self.topic,
            messages,
            size,
            dropped,
            len(self._served),
            counts,
            seconds,
            "" if self._header is None else self._header.get("md5sum", "")[:32],
            0.0 if messages else silent,
        )
        self._reported = True
        return row

    def _serve(self, member: TopicSubscriber, header: Mapping[str, str]) -> bool:
        """Return whether the subscriber has ended, or has got all earlier messages that are meant for it."""
        if not member.greet(header):
            return True
        self._served.add(member)
        self.differs()
        self.announce()
        self._reported = False
        if self.latch.batch is not None:
            batches = [self.latch.batch]
        else:
            batches = self._startup_replay.give(member.caller_id, self._clock())
        for batch in batches:
            self._served.deliver(batch, member)
        self.relieve()
        return not self._latches_others if self.latch.is_latching else bool(batches)

    def _forget_header(self) -> None:
        needed = self._served or self._superseded or self.latch.batch is not None
        if self._state is TopicState.LOST and not needed:
            self._state, self._header = TopicState.UNKNOWN, None

    def announce(self) -> None:
        if self._header is not None:
            self.upstream.announce(
                lambda: seen_names(self._served, self._servers(self.topic)), self._header.get("type", "")
            )

    def _pause_or_trim(self) -> None:
        since = [member.behind_since for member in self._served.row if member.behind_since is not None]
        if since and len(since) == len(self._served):
            left = max(since) + self._grace - self._clock()
            if left > 0:
                self.upstream.pause(left)
                return
        self._served.trim()


def _identity(header: Mapping[str, str]) -> tuple[str | None, ...]:
    return tuple(header.get(field) for field in ("type", "md5sum", "message_definition", "latching"))


def _digest(frame: memoryview) -> bytes:
    return hashlib.blake2b(frame, digest_size=16).digest()
