# cython: language_level=3, boundscheck=True, wraparound=False, initializedcheck=True, nonecheck=True, freethreading_compatible=False
"""Take whole small frames from a publisher to its subscribers while only the common work has to be done for them.

Theory of operation:

On a robot most messages come alone and find cold caches, where Python between `recv` and `send` costs twice what the
two calls cost. So the event loop waits in `Pump.wait`. If one descriptor is ready, and it is a publisher's connection
that is *armed*, `PumpedConnection` performs one step without Python code: receive into the scratch area, check that
it contains whole small frames, call the monitors' module, keep the monitors' state, send to each subscriber, count.
Then it waits again. In every other case `wait` returns the ready descriptors to Python.

Python remains the definition of what happens. It arms a connection when it has found that the next frames need no
other work. This holds for one version of the topic (`plain`) and of the monitors (`preparation`). Whatever changes one
of them changes its version, and a step begins by comparing both. A step that meets anything else stops where it
is: its handler gets a `Left` from `step` and goes on from there. A frame is never judged or sent twice.

What a step leaves to Python, with what it has done so far:
- `RECEIVED`: an error or end of the connection, a large frame, too many frames, a long incomplete frame, monitors that
  are not prepared. The bytes are in the scratch area, unread.
- `JUDGED`: the module was called and wants more than changes in place. Its answer, or its trap, is passed on.
- `SENT`: a subscriber did not accept everything. It and the later subscribers are left.

Bounds: a step makes one `recv` of at most the scratch area and at most `SUBSCRIBERS` sends; the module's work is
bounded by its fuel. `wait` returns when a step took longer than `LITTLE`, so that its payer is charged, and when the
deadline of a timer has passed. If several descriptors are ready, Python divides the processor time among their payers.

Memory safety: the scratch area, the module's memory and the state's memory are buffers of Python that are held while
they are used. Each access goes through `_part`, which checks it. Descriptors are never closed here. The only addresses
from outside are those of the module's function (`rosmop.run.fast_path.NativeCall`).
"""

from cpython.exc cimport PyErr_CheckSignals
from cpython.list cimport PyList_GetItem
from libc.errno cimport EAGAIN, EINTR, errno
from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t, uintptr_t
from libc.string cimport memcmp, memcpy
from libc.time cimport time_t

import sys
from typing import NamedTuple

from appliance.channel.messages import DELAY_BOUNDS

cdef extern from "<sys/epoll.h>" nogil:
    ctypedef struct epoll_data_t:  # in C a union: only one member is used
        int fd
    cdef struct epoll_event:
        uint32_t events
        epoll_data_t data
    int epoll_wait(int epoll, epoll_event *events, int most, int milliseconds)
    enum: EPOLLIN

cdef extern from "<sys/socket.h>" nogil:
    ssize_t recv(int descriptor, void *buffer, size_t size, int flags)
    ssize_t send(int descriptor, const void *buffer, size_t size, int flags)
    enum: MSG_DONTWAIT, MSG_NOSIGNAL

cdef extern from "<time.h>" nogil:
    cdef struct timespec:
        time_t tv_sec
        long tv_nsec
    int clock_gettime(int clock, timespec *now)
    enum: CLOCK_MONOTONIC

cdef extern from *:
    """#define keep_order() __atomic_signal_fence(__ATOMIC_SEQ_CST)"""
    void keep_order() noexcept nogil  # the process may be killed between any two stores

# wasmtime_func_call_unchecked(store, function, slots, number of slots, trap)
ctypedef void *(*invoke_t)(void *, void *, uint64_t *, size_t, void **)

cdef enum:
    _SUBSCRIBERS = 16
    _FRAMES = 4096
    _LARGE = 128 << 10
    _SMALL = 4 << 10
    _EVENTS = 1024
    _BOUNDS = 10
    _OPTIONS = 32
    _PARTS = 16
    _BASE = 1
    _CELLS = 2
    _HAS_CELLS = 4
    _UNARMED = 0
    _RECEIVED = 1
    _JUDGED = 2
    _SENT = 3

SUBSCRIBERS = _SUBSCRIBERS
SMALL, LARGE = _SMALL, _LARGE
BASE, CELLS, HAS_CELLS = _BASE, _CELLS, _HAS_CELLS  # bits of a section's byte, explained in state_memory.py
UNARMED, RECEIVED, JUDGED, SENT = _UNARMED, _RECEIVED, _JUDGED, _SENT
LITTLE = 1e-4
"""Seconds of a step that are not charged, because no other descriptor was ready when it began."""

cdef int64_t _LITTLE = int(LITTLE * 1e9)
cdef int64_t _NEVER = (1 << 63) - 1
_ALL = sys.maxsize
cdef int64_t _TOLD = 1 << 60  # this bit and the higher ones of an answer want more work (rosmop/fast/abi.py)
cdef int64_t _ADDRESS = 0xFFFFFFFF
cdef int64_t _BOUND[_BOUNDS]
for _number, _seconds in enumerate(DELAY_BOUNDS):
    _BOUND[_number] = int(_seconds * 1e9)


cdef struct Span:  # memory that a buffer of Python keeps in its place
    uint8_t *start
    Py_ssize_t size


cdef Span _span(uint8_t[::1] buffer) except *:
    return Span(&buffer[0], buffer.shape[0])


cdef inline uint8_t *_part(Span span, Py_ssize_t at, Py_ssize_t size) except NULL:
    """Return the address of a part; every access of this module to a span goes through this check."""
    if at < 0 or size < 1 or size > span.size or at > span.size - size:
        raise IndexError(f"{size} bytes at {at} are outside a memory of {span.size}")
    return span.start + at


cdef inline int64_t _now() noexcept nogil:
    cdef timespec now
    clock_gettime(CLOCK_MONOTONIC, &now)
    return <int64_t>now.tv_sec * 1_000_000_000 + now.tv_nsec


def walk(const uint8_t[::1] frames, Py_ssize_t messages=_ALL, Py_ssize_t size=_ALL) -> tuple[int, int, int]:
    """Walk over whole frames until there are this number of messages, or bytes, or no further whole frame.

    Return the bytes and messages passed, and the offset of the last of these frames.
    """
    cdef Py_ssize_t at = 0, last = 0, passed = 0, need
    cdef Span span
    if frames.shape[0]:
        span = Span(<uint8_t *>&frames[0], frames.shape[0])
    while passed < messages and at < size and frames.shape[0] - at >= 4:
        need = 4 + _word(span, at)
        if need > frames.shape[0] - at:
            break
        last = at
        at += need
        passed += 1
    return at, passed, last


cdef class Version:
    """The version of something that an armed connection relies on."""

    cdef readonly int64_t number

    def change(self) -> None:
        """Make the next steps ask Python again."""
        self.number += 1


cdef class Traffic:
    """The messages of one topic: how many passed since the last `take`, and the number of the next one.

    The delay of a batch runs from its receipt until it is handed to the subscribers' sockets; each message of the batch
    counts. Time in the queue of a slow subscriber does not count. `late` counts those delayed by more than `bound`
    seconds, and never begins again; `longest` is the longest delay since the last `take` (ns).
    """

    cdef readonly int64_t messages, size, following, late, longest
    cdef int64_t _counts[_BOUNDS + 1]
    cdef int64_t _nanoseconds, _bound

    def __cinit__(self, double bound=1e9):
        self.following = 1
        self._bound = <int64_t>(min(bound, 1e9) * 1e9)

    def add(self, messages: int, size: int) -> None:
        """Count messages, and their bytes."""
        self._add(messages, size)

    cdef void _add(self, int64_t messages, int64_t size) noexcept:
        self.messages += messages
        self.size += size
        self.following += messages

    def delayed(self, seconds: float, messages: int) -> None:
        """Count messages with this delay."""
        self._delay(<int64_t>(<double>seconds * 1e9), messages)

    cdef void _delay(self, int64_t nanoseconds, int64_t messages) noexcept:
        cdef int number = 0
        while number < _BOUNDS and _BOUND[number] < nanoseconds:
            number += 1
        self._counts[number] += messages
        self._nanoseconds += nanoseconds * messages
        self.longest = max(self.longest, nanoseconds)
        if nanoseconds > self._bound:
            self.late += messages

    def take(self) -> tuple[int, int, list[int], float]:
        """Return and reset the messages, their bytes, the counts of delays (empty: none) and their sum in seconds."""
        counts = [self._counts[number] for number in range(_BOUNDS + 1)]
        taken = self.messages, self.size, counts if any(counts) else [], self._nanoseconds / 1e9
        self.messages = self.size = self._nanoseconds = self.longest = 0
        for number in range(_BOUNDS + 1):
            self._counts[number] = 0
        return taken


cdef class ModuleCall:
    """The call of a monitors' module for the frames of one topic, and the place of the monitors' state.

    `native` is the lane's `NativeCall`, `options` its `BatchOptions`, and `place` the `CellsPlace` of its state. The call
    is valid before the time `until` (ns), and while `preparation` keeps its version. `offset` is the difference between
    the monitors' clock and the monotonic clock (ns).
    """

    cdef Version _preparation
    cdef int64_t _version, _offset, _until
    cdef invoke_t _invoke
    cdef void *_context
    cdef void *_function
    cdef Span _memory, _kept
    cdef Py_ssize_t _frames, _effects, _output, _sure, _flags, _first, _second, _options
    cdef uint8_t _wanted[_OPTIONS]
    cdef int _parts
    cdef Py_ssize_t _at[_PARTS]
    cdef Py_ssize_t _size[_PARTS]
    cdef uint64_t _slots[6]
    cdef int64_t _result, _who, _times
    cdef object _failure, _native, _given
    cdef uint8_t[::1] _memory_buffer, _kept_buffer

    def __init__(self, preparation: Version, native, options, place, *, offset: int, until: int) -> None:
        self._preparation, self._version = preparation, preparation.number
        self._offset, self._until = offset, min(until, _NEVER)
        self._native, self._given = native, options
        self._invoke = <invoke_t><uintptr_t>native.invoke
        self._context, self._function = <void *><uintptr_t>native.context, <void *><uintptr_t>native.function
        self._memory_buffer, self._kept_buffer = native.memory, place.memory
        self._memory, self._kept = _span(self._memory_buffer), _span(self._kept_buffer)
        self._frames, self._effects = native.frames, native.effects
        self._output, self._sure, self._options = native.output, native.sure, native.options
        wanted = native.packed(options)
        memcpy(self._wanted, <const char *><bytes>wanted, min(len(wanted), _OPTIONS))
        self._flags, (self._first, self._second) = place.flags, place.cells
        if len(wanted) != _OPTIONS or len(native.cells) > _PARTS:
            raise ValueError(f"too much for a step: {len(wanted)} bytes of options, {len(native.cells)} parts of a state")
        self._parts = 0
        for at, size in native.cells[:_PARTS]:
            self._at[self._parts], self._size[self._parts] = at, size
            self._parts += 1

    @property
    def valid(self) -> bool:
        """Whether steps may make this call."""
        return self._preparation.number == self._version

    def settle(self) -> None:
        """Add the changed messages that were counted here to the options' counts."""
        if self._times:
            changed = self._given.changed
            changed[self._who] = changed.get(self._who, 0) + self._times
            self._times = 0

    cdef bint _ready(self, Span area, int64_t received) except -1:
        """Whether the module may judge frames at the start of this area at this time."""
        return received + self._offset < self._until and area.start == _part(self._memory, self._frames, area.size)

    cdef bint _judge(self, Py_ssize_t size, int64_t received) except -1:
        """Judge `size` bytes of frames; return whether all pass and only counts are left to do."""
        cdef void *trap = NULL
        cdef void *error
        cdef int64_t effects
        if memcmp(_part(self._memory, self._options, _OPTIONS), self._wanted, _OPTIONS) and not self._prepare():
            return False
        self._slots[0], self._slots[2], self._slots[4] = self._frames, self._frames + size, received + self._offset
        error = self._invoke(self._context, self._function, self._slots, 3, &trap)
        if error != NULL or trap != NULL:
            self._failure = self._native.failure(<uintptr_t>error, <uintptr_t>trap)
            return False
        self._result = <int64_t>self._slots[0]
        if self._result < 0 or self._result >= _TOLD or (self._result & _ADDRESS) != self._frames + size:
            return False
        if self._output and _word(self._memory, self._sure) > self._output:
            return False
        effects = self._result >> 32  # no higher bit is set
        return not effects or self._count(effects)

    cdef object _answer(self):
        """Return the module's answer, or the exception in its place."""
        failure, self._failure = self._failure, None
        return self._result if failure is None else failure

    cdef bint _prepare(self) except -1:
        """Move the state into the module, with the options; a defect is left to Python, which reports it."""
        try:
            self._native.home.prepare(self._given)
        except Exception as error:
            self._failure = error
            return False
        return True

    cdef bint _count(self, Py_ssize_t effects) except -1:
        """Count the changed messages; return False, with nothing counted, if one of the effects is a drop."""
        cdef int64_t effect[2]
        cdef Py_ssize_t number
        cdef uint8_t *found = _part(self._memory, self._effects, 16 * effects)
        for number in range(effects):
            memcpy(effect, found + 16 * number, 16)
            if effect[0] == -1:
                return False
        for number in range(effects):
            memcpy(effect, found + 16 * number, 16)
            if effect[0] != self._who:
                self.settle()
                self._who = effect[0]
            self._times += effect[1]
        return True

    cdef int _keep(self) except -1:
        """Keep the monitors' state if it has changed, in the order of writes of `state_memory.py`."""
        cdef Py_ssize_t place
        cdef uint8_t *flags
        cdef int number
        cdef bint same
        if self._flags < 0:
            return 0
        flags = _part(self._kept, self._flags, 1)
        same = flags[0] & _HAS_CELLS
        place = self._second if flags[0] & _CELLS else self._first
        for number in range(self._parts):
            same = same and not memcmp(self._state(number), _part(self._kept, place, self._size[number]),
                                       self._size[number])
            place += self._size[number]
        if same:
            return 0
        place = self._first if flags[0] & _CELLS else self._second
        for number in range(self._parts):
            memcpy(_part(self._kept, place, self._size[number]), self._state(number), self._size[number])
            place += self._size[number]
        keep_order()
        flags[0] = flags[0] & _BASE | (flags[0] & _CELLS ^ _CELLS) | _HAS_CELLS
        keep_order()
        return 0

    cdef uint8_t *_state(self, int number) except NULL:
        return _part(self._memory, self._at[number], self._size[number])


cdef inline int64_t _word(Span span, Py_ssize_t at) except -1:
    cdef uint32_t word = 0
    memcpy(&word, _part(span, at, 4), 4)  # little-endian, like every machine that the appliance runs on
    return word


class Left(NamedTuple):
    """The work that a step leaves to Python.

    `kind` says how far it came. `end` is the number of bytes at the start of the scratch area (`RECEIVED`: 0 for the end
    of the connection, less than 0 for an error number). The first `size` bytes are `messages` whole frames. They were
    received at `since` (seconds, `time.monotonic`) and judged at `judged` (ns, the monitors' clock; 0: no monitors) with
    `answer`. Subscriber `number` accepted `sent` bytes (less than 0: an error number).
    """

    kind: int
    end: int = 0
    size: int = 0
    messages: int = 0
    since: float = 0.0
    judged: int = 0
    answer: object = None
    number: int = 0
    sent: int = 0


_UNARMED_LEFT = Left(_UNARMED)


cdef class PumpedConnection:
    """One publisher's connection, as the pump sees it; made by `Pump.connection`."""

    cdef readonly Pump pump
    cdef Traffic _traffic
    cdef Version _plain
    cdef int64_t _version, _since, _ended
    cdef ModuleCall _module
    cdef object _topic, _left
    cdef int _descriptor, _subscribers
    cdef int _to[_SUBSCRIBERS]
    cdef uint8_t _torn[_SMALL]
    cdef Py_ssize_t _kept
    cdef bint _stepped, _crowd

    def arm(self, int descriptor, topic, subscribers, ModuleCall module, bytes torn) -> None:
        """Let steps take the frames of `descriptor` to these subscribers' descriptors while `topic.plain` does not change.

        The frames continue the incomplete frame `torn`.
        """
        if len(subscribers) > _SUBSCRIBERS or len(torn) > _SMALL:
            raise ValueError(f"too much for a step: {len(subscribers)} subscribers, {len(torn)} bytes")
        self._kept = len(torn)
        memcpy(self._torn, <const char *>torn, self._kept)
        self._subscribers = 0
        for one in subscribers[:_SUBSCRIBERS]:
            self._to[self._subscribers] = one
            self._subscribers += 1
        self._descriptor, self._topic, self._module = descriptor, topic, module
        self._plain = topic.plain
        self._version = self._plain.number
        self._traffic = topic.counters

    def disarm(self) -> bytes:
        """Leave all frames to Python; return the incomplete frame that was received so far."""
        self._topic = self._plain = self._module = self._left = None
        self._stepped = False
        torn, self._kept = self._torn[: self._kept], 0
        return torn

    cdef bint _is_armed(self) except -1:
        """Whether a step is possible now."""
        if self._plain is None or self._plain.number != self._version:
            return False
        return self._module is None or self._module._preparation.number == self._module._version

    def step(self) -> Left | None:
        """Perform a step, unless `Pump.wait` has just done so; return what is left to do (None: nothing)."""
        if not self._stepped and (not self._is_armed() or self._step() < 0):
            return _UNARMED_LEFT
        self._stepped = False
        left, self._left = self._left, None
        return left

    cdef int64_t _step(self) except -1:
        """Perform a step; return the nanoseconds that it took. `_left` is what is left to do."""
        cdef Span area = self.pump._area
        cdef Py_ssize_t got, end, size = 0, messages = 0, sent
        cdef int number
        self._stepped = True
        got = recv(self._descriptor, _part(area, self._kept, area.size - self._kept), area.size - self._kept, MSG_DONTWAIT)
        self._since = self._ended = _now()
        if got <= 0:
            if got == 0 or errno != EAGAIN:
                self._left = Left(_RECEIVED, 0 if got == 0 else -errno)
            return 0
        if self._kept:
            memcpy(_part(area, 0, self._kept), self._torn, self._kept)
        end, self._kept = self._kept + got, 0
        if (
            not _whole(area, end, &size, &messages)
            or size > _LARGE and not self._topic.keeps_large
            or self._module is not None and not self._module._ready(area, self._since)
        ):
            self._left = Left(_RECEIVED, end)
            return 0
        if self._module is not None and size:
            if not self._module._judge(size, self._since):
                self._left = self._whole_left(_JUDGED, end, size, messages, self._module._answer(), 0, 0)
                return 0
            self._module._keep()
        for number in range(self._subscribers if size else 0):
            sent = send(self._to[number], _part(area, 0, size), size, MSG_DONTWAIT | MSG_NOSIGNAL)
            if sent != size:
                sent = sent if sent >= 0 else -errno
                self._left = self._whole_left(_SENT, end, size, messages, None, number, sent)
                return 0
        if end > size:
            memcpy(self._torn, _part(area, size, end - size), end - size)
            self._kept = end - size
        self._ended = _now()
        self._traffic._add(messages, size)
        if self._subscribers and messages:
            self._traffic._delay(self._ended - self._since, messages)
        return self._ended - self._since

    cdef object _whole_left(self, kind, end, size, messages, answer, number, sent):
        judged = 0 if self._module is None else self._module._offset + self._since
        return Left(kind, end, size, messages, self._since / 1e9, judged, answer, number, sent)


cdef bint _whole(Span area, Py_ssize_t end, Py_ssize_t *size, Py_ssize_t *messages) except -1:
    """Find the whole frames in `area[:end]`; return whether they, and the rest, are small and not too many."""
    cdef Py_ssize_t need, at = 0
    while end - at >= 4:
        need = 4 + _word(area, at)
        if need > _LARGE:
            return False
        if need > end - at:
            break
        at += need
        messages[0] += 1
    size[0] = at
    return messages[0] <= _FRAMES and end - at <= _SMALL


cdef class Pump:
    """Waits for events of an epoll (`epoll`: its descriptor), and performs the steps of armed connections."""

    cdef int _epoll
    cdef Span _area
    cdef uint8_t[::1] _area_buffer
    cdef list _connections
    cdef Py_ssize_t _known
    cdef epoll_event _events[_EVENTS]
    cdef readonly double began
    """When the step began to which the last result of `wait` belongs (seconds, `time.monotonic`); 0 without a step."""

    def __init__(self, int epoll) -> None:
        self._epoll, self._connections = epoll, []

    def receive_into(self, uint8_t[::1] area) -> None:
        """Receive into this area from the next step on."""
        if area.shape[0] < 2 * _SMALL:
            raise ValueError(f"a scratch area of {area.shape[0]} bytes is too small")
        self._area_buffer, self._area = area, _span(area)

    def connection(self) -> PumpedConnection:
        """Return an unarmed connection."""
        cdef PumpedConnection made = PumpedConnection()
        made.pump = self
        return made

    def put(self, int descriptor, PumpedConnection entry) -> None:
        """Set the connection whose events have this descriptor (None: no steps)."""
        if descriptor >= len(self._connections):
            if entry is None:
                return
            self._connections += [None] * (descriptor + 1 - len(self._connections))
            self._known = len(self._connections)
        self._connections[descriptor] = entry

    def wait(self, double longest, int most, bint steps) -> list:
        """Wait for at most `longest` seconds; return up to `most` ready descriptors with their events.

        With `steps`, perform the steps of connections that are ready alone. A connection whose step left work, or took
        long, is in the result.
        """
        cdef int64_t now = _now(), deadline = now + <int64_t>(longest * 1e9)
        cdef int found
        cdef PumpedConnection connection
        self.began = 0.0
        while True:
            found = self._poll(min(most, _EVENTS), deadline - now)
            if found == 1 and steps:
                connection = self._alone()
                if connection is not None:
                    if connection._step() > _LITTLE or connection._left is not None:
                        self.began = connection._since / 1e9
                        return [(connection._descriptor, EPOLLIN)]
                    connection._stepped = False
                    now = connection._ended
                    if now >= deadline:
                        return []
                    continue
            return [(self._events[number].data.fd, self._events[number].events) for number in range(found)]

    def crowd(self, int descriptor) -> None:
        """Look for connections in the epoll with this descriptor, too."""
        cdef PumpedConnection crowd = self.connection()
        crowd._crowd = True
        self.put(descriptor, crowd)

    cdef PumpedConnection _alone(self):
        """Return the armed connection of the only event, if it is one."""
        cdef epoll_event inner[2]
        cdef epoll_event event = self._events[0]
        cdef PumpedConnection entry = self._entry(event.data.fd)
        if entry is not None and entry._crowd and epoll_wait(event.data.fd, inner, 2, 0) == 1:
            event = inner[0]
            entry = self._entry(event.data.fd)
        if entry is not None and event.events == EPOLLIN and entry._is_armed():
            return entry
        return None

    cdef PumpedConnection _entry(self, Py_ssize_t descriptor):
        if descriptor >= self._known:
            return None
        return <PumpedConnection>PyList_GetItem(self._connections, descriptor)  # `put` takes no others

    cdef int _poll(self, int most, int64_t nanoseconds) except -1:
        """Wait for events, and return their number; 0 also after a signal."""
        cdef int found, milliseconds = 0, error
        cdef int epoll = self._epoll
        cdef epoll_event *events = self._events
        if nanoseconds <= 0:
            found = epoll_wait(epoll, events, most, 0)
            error = errno
        else:
            milliseconds = (nanoseconds + 999_999) // 1_000_000
            with nogil:
                found = epoll_wait(epoll, events, most, milliseconds)
                error = errno
        if found < 0:
            if error != EINTR:
                raise OSError(error, "epoll_wait failed")
            PyErr_CheckSignals()
            return 0
        return found
