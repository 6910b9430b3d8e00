"""Explain a verdict by a few past events that suffice for it.

Each explanation is tested: its events must give the verdict.

1. With tables, `Exits` stores for each state the event that left it last. From the initial state these events lead to
the present state: the trace without its loops, however long it is.
2. For other properties, `Steps` keeps the last events and the run before them. If the events do not give the verdict
to a new run, they explain it only with that run (`Explanation.since`). A run about the future is not copied, but
knows at which event the decided formula was evaluated. The events from there on suffice, unless the formula also
looks back; then there is no explanation.
3. For a parametric specification, the last `TRAIL` events must explain a slice's verdict alone.
"""

import copy
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rosmop.logics.automaton import Automaton
from rosmop.logics.bounded import BoundedRun
from rosmop.logics.interface import (
    Categories,
    ClockedProperty,
    ClockedRun,
    CompiledProperty,
    FiniteProperty,
    Run,
    RunFaultError,
)
from rosmop.run.outcomes import NOBODY, EventOccurrence, Explanation, MessageSender

TRAIL = 4096

KEPT = 64

FUTURE_KEPT = 1024

ENTRY = struct.Struct("<qqI4x")
"""Time (ns) when a state was left; source of the sender; its kind (from bit 24) and the event; its number."""

RUNS, RING = 4, 256
"""The runs and steps kept for a property with a clock.

They are twice as many as needed, so that a message that the module leaves to the engine overwrites no needed
entry.
"""

_COUNT = struct.Struct("<q")
_RUN = struct.Struct("<qqq")
_EVENT = 0xFFFFFF
_LONGEST = 300  # longest path through an automaton that is shortened
_MAX_STEPS = 5_000  # the maximum number of steps tried for one explanation: some milliseconds
_DEADLINE = -1

CLOCKED_ROOM = _COUNT.size + _RUN.size * RUNS + ENTRY.size * RING


class Bound(NamedTuple):
    """An event of a parametric specification that happened: parameters by number, and their values after True.

    It happened `everywhere` if in each of its slices: a `when` may depend on the slice, and a message that
    one slice drops reaches no other slice. It is `passed` if its message was not dropped.
    """

    event: int
    binds: tuple[int, ...]
    key: tuple[object, ...]
    time: int
    sender: MessageSender
    creates: bool
    everywhere: bool = True
    passed: bool = True


class Exits:
    """How each state of an automaton was left last.

    It is stored in `room` (an `ENTRY` for each state), which `owner` keeps alive.
    """

    def __init__(self, automaton: Automaton) -> None:
        self._automaton = automaton
        self._last = 0, 0, NOBODY
        self._at = automaton.initial
        self.room = memoryview(bytearray(ENTRY.size * len(automaton)))
        self.owner: object = None

    def step(self, run: Any, event: int, time_ns: int, sender: MessageSender) -> Categories:
        self._at = state = run.state
        self._last = event, time_ns, sender
        categories: Categories = run.step(event, time_ns)
        if run.state != state:
            source, number, kind, _ = sender
            who = source << 32 | kind << 24 | event
            ENTRY.pack_into(self.room, ENTRY.size * state, time_ns, who, number & 0xFFFFFFFF)
        return categories

    def expire(self, run: Run) -> Categories:
        return run.expire()

    def begin(self, time_ns: int) -> None:
        """Do nothing: a path from the initial state never has earlier events."""

    def mark(self) -> None:
        """Do nothing: a path from the initial state never has an undone step."""

    def take_back(self, mark: object) -> None: ...

    def move(self, owner: object, room: memoryview) -> None:
        self.room, self.owner = room[: len(self.room)], owner

    def forget(self, run: Any, _time_ns: int) -> None:
        """Forget all exits, because the run continues a run of another process."""
        self._at = run.state
        for state in range(len(self._automaton)):
            ENTRY.pack_into(self.room, ENTRY.size * state, 0, _EVENT, 0)

    def follow(self, earlier: "Exits | Steps") -> "Exits":
        assert isinstance(earlier, Exits)  # noqa: S101  it has the same tables
        self.room[:] = bytes(earlier.room)
        return self

    def explain(self, category: str) -> Explanation | None:
        way = self._way()
        if way is None:
            return None
        way.append(EventOccurrence(*self._last))
        fewest = len(way) <= _LONGEST
        return Explanation(self._named(_shortest(self._automaton, way, category) if fewest else way), fewest)

    def _way(self) -> list[EventOccurrence] | None:
        occurrences: list[EventOccurrence] = []
        state = self._automaton.initial
        while state != self._at:
            time, who, number = ENTRY.unpack_from(self.room, ENTRY.size * state)
            if (
                who & _EVENT == _EVENT
                or len(occurrences) == len(self._automaton)
                or (occurrences and time < occurrences[-1].time)
            ):
                return None
            sender = MessageSender(who >> 32, number, who >> 24 & 0xFF)
            occurrences.append(EventOccurrence(who & 0xFFFFFF, time, sender))
            state = self._automaton.table[state][occurrences[-1].event]
        return occurrences

    def _named(self, way: Sequence[EventOccurrence]) -> tuple[EventOccurrence, ...]:
        automaton, state, found = self._automaton, self._automaton.initial, []
        for event in way:
            state = automaton.table[state][event.event]
            found.append(event._replace(state=automaton.names[state]) if automaton.names else event)
        return tuple(found)


def _shortest(
    automaton: Automaton, way: Sequence[EventOccurrence], category: str
) -> Sequence[EventOccurrence]:
    best: dict[int, tuple[int, ...]] = {automaton.initial: ()}
    fewest: tuple[int, ...] = ()
    mine: tuple[int, ...] = ()
    for number, event in enumerate(way):
        found = dict(best)
        mine = ()
        for state, before in best.items():
            target, now = automaton.table[state][event.event], (*before, number)
            if len(now) <= len(found.get(target, now)):
                found[target] = now
            if category in automaton.verdicts[target]:
                if not mine or len(now) <= len(mine):
                    mine = now
                if not fewest or len(now) <= len(fewest):
                    fewest = now
        best = found
    state = automaton.initial
    for number in mine[:-1]:
        state = automaton.table[state][way[number].event]
    chosen = fewest if mine[:-1] and category in automaton.verdicts[state] else mine
    return [way[number] for number in chosen]


class Steps:
    """The history of a property without tables."""

    _run: Run | None = None

    def __init__(self, compiled: CompiledProperty, time_ns: int) -> None:
        self._compiled = compiled
        self.begin(time_ns)

    def begin(self, time_ns: int) -> None:
        self._started = time_ns
        self._steps: list[EventOccurrence] = []
        self._before: Run | None = None
        self._following: Run | None = None

    def mark(self) -> Any:
        return self._started, self._steps, len(self._steps), self._before, self._following

    def take_back(self, mark: Any) -> None:
        self._started, self._steps, size, self._before, self._following = mark
        del self._steps[size:]

    def step(self, run: Run, event: int, time_ns: int, sender: MessageSender) -> Categories:
        self._make_room(run)
        categories = run.step(event, time_ns)
        self._steps.append(EventOccurrence(event, time_ns, sender))
        return categories

    def forget(self, run: Run, time_ns: int) -> None:
        """Explain only from the present state on, because the run continues a run of another process."""
        self.begin(time_ns)
        self._before = None if isinstance(run, BoundedRun) else copy.copy(run)

    def add(self, happened: EventOccurrence) -> None:
        self._steps.append(happened)

    def expire(self, run: Run) -> Categories:
        self._make_room(run)
        self._steps.append(EventOccurrence(_DEADLINE, run.deadline or 0, NOBODY))
        return run.expire()

    def follow(self, earlier: "Exits | Steps") -> "Exits | Steps":
        return earlier

    def _kept(self) -> tuple[Sequence[EventOccurrence], Run | None]:
        return self._steps, self._before

    def _make_room(self, run: Run) -> None:
        self._run = run
        kept = FUTURE_KEPT if isinstance(run, BoundedRun) else KEPT
        if len(self._steps) == 2 * kept:
            self._steps = self._steps[kept:]
            self._before = self._following
        if len(self._steps) == kept:
            self._following = None if isinstance(run, BoundedRun) else copy.copy(run)

    def explain(self, category: str) -> Explanation | None:
        steps, earlier = self._kept()
        if not steps:
            return None
        ended = steps[-1].time if steps[-1].event == _DEADLINE else None
        events = [step for step in steps if step.event != _DEADLINE]
        last = events[-1:] if ended is None else []
        tries: list[tuple[Run | None, list[EventOccurrence]]] = [(None, events)]
        if earlier is not None:
            tries.append((earlier, events))
        if isinstance(self._run, BoundedRun):
            first = len(events) - 1 - (self._run.place - self._run.about(category))
            if 0 <= first < len(events) - len(last):
                tries = [(None, [events[first], *last]), (None, events[first:]), *tries]
        for before, some in tries:
            tried = _Trial(self._compiled, before, self._started, category, ended)
            if tried.gives(some):
                since = steps[0].time if before is not None else None
                return Explanation(*tried.fewest(some), since=since)
        return None


class ClockedSteps(Steps):
    """Like `Steps`, for an automaton with a clock; the module stores the same data in `room`.

    `room` has the number of steps (i64), the last `RUNS` saved runs, and the last `RING` steps. A run (state, `since`
    and `now`) is saved before each group of `KEPT` steps.
    """

    _compiled: ClockedProperty

    def __init__(self, compiled: ClockedProperty, time_ns: int) -> None:
        self.room = memoryview(bytearray(CLOCKED_ROOM))
        self.owner: object = None
        super().__init__(compiled, time_ns)

    def begin(self, time_ns: int) -> None:
        self._started = time_ns
        _COUNT.pack_into(self.room, 0, 0)

    def mark(self) -> tuple[int, bytes]:
        return self._started, bytes(self.room)

    def take_back(self, mark: tuple[int, bytes]) -> None:
        self._started, self.room[:] = mark

    def step(self, run: Run, event: int, time_ns: int, sender: MessageSender) -> Categories:
        self._note(run, event, time_ns, sender)
        return run.step(event, time_ns)

    def forget(self, run: Run, time_ns: int) -> None:
        del run
        self.begin(time_ns)

    def expire(self, run: Run) -> Categories:
        self._note(run, _DEADLINE & _EVENT, run.deadline or 0, NOBODY)
        return run.expire()

    def move(self, owner: object, room: memoryview) -> None:
        self.room, self.owner = room[:CLOCKED_ROOM], owner

    def follow(self, earlier: Exits | Steps) -> "ClockedSteps":
        assert isinstance(earlier, ClockedSteps)  # noqa: S101  it has the same tables
        self._started = earlier._started
        self.room[:] = bytes(earlier.room)
        return self

    def _note(self, run: Any, event: int, time_ns: int, sender: MessageSender) -> None:
        (count,) = _COUNT.unpack_from(self.room)
        if not count % KEPT:
            _RUN.pack_into(self.room, _run_at(count // KEPT), run.state, run.since, run.now)
        source, number, kind, _ = sender
        who = source << 32 | kind << 24 | event
        ENTRY.pack_into(self.room, _step_at(count), time_ns, who, number & 0xFFFFFFFF)
        _COUNT.pack_into(self.room, 0, count + 1)

    def _kept(self) -> tuple[Sequence[EventOccurrence], Run | None]:
        (count,) = _COUNT.unpack_from(self.room)
        first = max((count - 1) // KEPT - 1, 0)
        steps = []
        for number in range(first * KEPT, count):
            time, who, of_sender = ENTRY.unpack_from(self.room, _step_at(number))
            event = _DEADLINE if who & _EVENT == _EVENT else who & _EVENT
            steps.append(EventOccurrence(event, time, MessageSender(who >> 32, of_sender, who >> 24 & 0xFF)))
        if not first:
            return steps, None
        run = ClockedRun(self._compiled, 0)
        run.state, run.since, run.now = _RUN.unpack_from(self.room, _run_at(first))
        return steps, run


def _run_at(number: int) -> int:
    return _COUNT.size + _RUN.size * (number % RUNS)


def _step_at(number: int) -> int:
    return _COUNT.size + _RUN.size * RUNS + ENTRY.size * (number % RING)


class _Trial:
    def __init__(
        self, compiled: CompiledProperty, before: Run | None, started: int, category: str, ended: int | None
    ) -> None:
        self._start: Callable[[], Run] = lambda: (
            compiled.start(started) if before is None else copy.copy(before)
        )
        self._category = category
        self._ended = ended
        self._left = _MAX_STEPS

    def gives(self, events: Sequence[EventOccurrence]) -> bool:
        self._left -= 1 + len(events)
        run = self._start()
        told: Categories = ()
        try:
            for event in events:
                self._expire(run, event.time)
                told = run.step(event.event, event.time)
        except RunFaultError:
            return False
        return self._category in (told if self._ended is None else self._expire(run, self._ended + 1))

    def _expire(self, run: Run, time_ns: int) -> Categories:
        told: Categories = ()
        while (deadline := run.deadline) is not None and deadline < time_ns:
            categories = run.expire()
            told += categories if deadline == time_ns - 1 else ()
        return told

    def fewest(self, events: list[EventOccurrence]) -> tuple[tuple[EventOccurrence, ...], bool]:
        last = events[-1:] if self._ended is None else []
        some = self._fewer(events[: len(events) - len(last)], last)
        if last and some and self._left > 0 and self.gives(some):
            some, last = self._fewer(some, []), []
        return (*some, *last), self._left > 0

    def _fewer(self, some: list[EventOccurrence], last: list[EventOccurrence]) -> list[EventOccurrence]:
        size = max(1, len(some) // 2)
        while some and self._left > 0:
            place, before = 0, len(some)
            while place < len(some) and self._left > 0:
                fewer = some[:place] + some[place + size :]
                if self.gives([*fewer, *last]):
                    some = fewer
                else:
                    place += size
            if size == 1 and len(some) == before:
                break
            size = max(1, size // 2)
        return some


def of_slice(
    compiled: CompiledProperty,
    trail: Iterable[Bound],
    values: Mapping[int, object],
    category: str,
    passed: int | None = None,
) -> Explanation | None:
    """Return the events that caused a verdict in one slice: `values` has the parameters of its binding, by number.

    `passed` is the deadline that gave the verdict; without it, the last event did. Returns None if the trail does
    not tell whether an event belongs to this slice.
    """
    own: dict[EventOccurrence, bool] = {}
    happened: list[EventOccurrence] = []
    for bound in trail:
        if not bound.passed and compiled.suppresses:
            continue
        if all(map(_same_value, map(values.get, bound.binds), bound.key[1:])) and (own or bound.creates):
            happened.append(EventOccurrence(bound.event, bound.time, bound.sender))
            own[happened[-1]] = bound.everywhere
    if not happened:
        return None
    steps = Steps(compiled, happened[0].time)
    for event in happened:
        steps.add(event)
    if passed is not None:
        steps.add(EventOccurrence(_DEADLINE, passed, NOBODY))
    why = steps.explain(category)
    return why if why is not None and all(own[event] for event in why.events) else None


def _same_value(one: object, other: object) -> bool:
    return bool(one == other or (one != one and other != other))  # noqa: PLR0124  NaN


def history_of(compiled: CompiledProperty, time_ns: int) -> Exits | Steps:
    if isinstance(compiled, ClockedProperty):
        return ClockedSteps(compiled, time_ns)
    return Exits(compiled.automaton) if isinstance(compiled, FiniteProperty) else Steps(compiled, time_ns)
