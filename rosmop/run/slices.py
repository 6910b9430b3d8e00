"""The slices of a running parametric specification (Chen and Roşu, "Parametric trace slicing and monitoring", 2012).

A *binding* gives a value to some or all of the parameters. The *slice* of a binding has the events whose bindings are
part of it, from the first `creation event` on. Each slice whose events bind all parameters is monitored like a
separate specification.

1. An event concerns every known binding that agrees with its own, joined with it. A new slice starts with the state
   of the largest known binding within its own, which is unique, because the union of two known bindings that agree is
   also known. Slices that lack a parameter (`seeds`) only provide such start states, without output.
2. Each slice has its own clocks, and one valid entry in the heap of deadlines (`Slice.due`), whose time may be too
   early, but never too late.
3. A slice ends when no event or deadline can lead to a handler any more, and its actions only change its own
   variables. Its binding is remembered, so that it does not start again. A slice in its initial state is forgotten at
   once if any relevant event would create it again.
4. No host (*holder*) has more slices than are left for all other hosts (`slice_quota.py`), and none causes the
   removal of another host's slice or ended binding. At its limit, the host's oldest slice is forgotten if the
   specification only observes. If it acts on messages or publishes, the new binding is `refused`, so that no host can
   get rid of an obligation.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import count, repeat
from operator import contains, getitem
from typing import Any, cast

from rosmop.form.compiled import EventCode, PropertyCode, SpecificationCode
from rosmop.form.sites import showing
from rosmop.logics.bounded import MAX_OPEN_IN_SLICE, BoundedProperty, BoundedRun
from rosmop.logics.interface import (
    Categories,
    ClockedProperty,
    CompiledProperty,
    FiniteProperty,
    FormulaRun,
    Run,
)
from rosmop.run.slice_quota import Holder, HolderOf, Quota
from rosmop.runtime.action_context import FOLDED_NS, ActionState
from rosmop.types import value_types
from rosmop.types.value_types import Value

LIMIT = 100_000

GROWING_LIMIT = 1_000
"""The most slices if a run needs more than an automaton (`cfg`, `srs`, `ptcaret`, `mtl` about the future)."""

TOGETHER_LIMIT = 250
"""The most slices if an event or a tick may concern all of them: each takes 2 µs, or 12 µs with a verdict."""

COPY_COST = 5_000
"""The instructions that a copy of a waiting event counts, for a new slice whose formulas begin as those of another."""

MAX_BINDING = 256
"""The most bytes of all strings of a binding together."""

Key = tuple[Value, ...]
"""True, and the values of the bound parameters, in their order."""

Binding = tuple[int, Key]
"""The bound parameters as a set of bits, and their values."""

_NAN = float("nan")  # dictionaries find this one object again, although NaN is not equal to itself


@dataclass(eq=False, slots=True)
class Slice:
    """One slice; `domain` has its parameters as bits.

    It is `kept` once an event has happened in it, and `gone` once it has ended or was forgotten.
    """

    domain: int
    key: Key
    runs: tuple[Run, ...]
    values: tuple[Value, ...]
    holder: Holder = None
    kept: bool = False
    gone: bool = False
    due: int | None = None
    turn: int = 0
    """The number of the slice's entry in the heap; at equal times, the smallest number comes first."""

    @property
    def deadline(self) -> int | None:
        times = [time for run in self.runs if (time := run.deadline) is not None]
        return min(times, default=None)

    def stand(self, states: Sequence[int]) -> None:
        for run, state in zip(self.runs, states, strict=True):
            run.state = state  # type: ignore[attr-defined]  # runs over tables


@dataclass(eq=False, slots=True)
class _Known:
    """The slices whose bindings have the same parameters; None for an ended slice.

    For each set of parameters in use, `parts` groups the same keys by their values.
    """

    slices: dict[Key, Slice | None] = field(default_factory=dict)
    parts: dict[int, dict[Key, dict[Key, None]]] = field(default_factory=dict)


class Slices:
    def __init__(
        self,
        code: SpecificationCode,
        namespace: dict[str, Value],
        limit: int,
        holder_of: HolderOf,
        turn: ActionState,
    ) -> None:
        assert code.slicing is not None  # noqa: S101  the caller checks this
        properties = [declared.property for declared in code.properties]
        self._all = (1 << len(code.slicing.parameters)) - 1
        self.limit = limit
        for one in properties:
            if isinstance(one, BoundedProperty):
                one.most = MAX_OPEN_IN_SLICE
        if any(not isinstance(one, FiniteProperty | ClockedProperty) for one in properties):
            self.limit = min(self.limit, GROWING_LIMIT)
        if any(_domain(event) != self._all for event in code.events):
            self.limit = min(self.limit, TOGETHER_LIMIT)
        self.refused: Mapping[str, object] | None = None
        self.why = ""
        self.changed: dict[Binding, Holder] | None = None
        self.behind: list[Slice] = []
        self._code = code
        self._holder_of = holder_of
        self._turn = turn
        self._namespace = namespace
        self._parameters = code.slicing.parameters
        self._own = code.slicing.own
        self._forgets = not code.slicing.enforces
        self._timed = any(one.timed for one in properties)
        self._floating = any(isinstance(kind, value_types.FloatingType) for _, _, kind in self._parameters)
        self._first: Slice
        self._holder: Holder = None
        self._now = 0
        self._known = {domain: _Known() for domain in _join(_domain(event) for event in code.events)}
        self.quota: Quota[Binding] = Quota(self.limit)
        self._ended: Quota[tuple[int, Key]] = Quota(self.limit)
        self._forgotten = 0
        self._told: int | None = None
        self._deadlines: list[tuple[int, int, Slice]] = []
        self._order = count()
        self._whole = self._known[self._all].slices
        self._formulas = [declared.property.suppresses for declared in code.properties]
        self.suppresses = any(self._formulas)
        self._look_at(code.properties)
        for wanted in {_domain(event) for event in code.events}:
            for domain, known in self._known.items():
                if wanted & domain not in (0, domain):
                    known.parts.setdefault(wanted & domain, {})

    @property
    def live(self) -> int:
        return self.quota.total

    def _look_at(self, properties: Sequence[PropertyCode]) -> None:
        self._properties, events = properties, self._code.events
        finite = [declared for declared in properties if isinstance(declared.property, FiniteProperty)]
        every = len(finite) == len(properties)
        tables = all(
            isinstance(declared.property, FiniteProperty | ClockedProperty) for declared in properties
        )
        ends = tables and bool(properties) and not any(event.acts for event in events)
        self._lost = [_lost(declared) for declared in properties] if ends else []
        self._renews = bool(properties) and _renews(events, properties, self._all)
        lost = self._lost or [frozenset()] * len(finite)
        self._calm = [
            [*map(_calm, finite, repeat(number), lost, repeat(self._renews))]
            if every and event.plain
            else None
            for number, event in enumerate(events)
        ]

    def begin(self, properties: Sequence[PropertyCode], runs: tuple[Run, ...]) -> None:
        self._look_at(properties)
        zero = tuple(self._namespace[code] for _, code, _ in self._parameters)
        values = self.own()
        self._first = Slice(0, (True, *zero), runs, values)
        self.quota.clear()
        self._ended.clear()
        self._deadlines.clear()
        for known in self._known.values():
            known.slices.clear()
            for part in known.parts.values():
                part.clear()

    def take_over(self, before: "Slices") -> None:
        self._first, self._known = before._first, before._known
        self.quota.take_over(before.quota)
        self._ended.take_over(before._ended)
        self._deadlines, self._order = before._deadlines, before._order
        self._whole = before._whole

    # The slices of an event

    def step(self, event: int, key: Key) -> bool | None:
        """Step the slice of an event that binds all parameters, if that only changes states; else return None.

        Return False if the slice has ended, so that the event does not happen.
        """
        if key not in self._whole:
            return None
        slice_, calm = self._whole[key], self._calm[event]
        if slice_ is None or calm is None:
            return False if slice_ is None else None
        if len(calm) == 1:  # the most common case
            run: Any = slice_.runs[0]
            state = calm[0][run.state]
            if state < 0:
                return None
            run.state = state
            self._note(slice_)
            return True
        after = [*map(getitem, calm, _states(slice_.runs))]
        if min(after, default=0) >= 0:
            slice_.stand(after)
            self._note(slice_)
            return True
        return None

    def at(self, key: Key) -> Slice | None:
        return self._whole.get(key)

    def quiet(self, event: int, slice_: Slice) -> Sequence[int] | None:
        calm = self._calm[event]
        if calm is None or not slice_.kept:
            return None
        after = [*map(getitem, calm, _states(slice_.runs))]
        return after if min(after, default=0) >= 0 else None

    def stand(self, slice_: Slice, states: Sequence[int]) -> None:
        slice_.stand(states)
        self._note(slice_)

    def targets(self, event: EventCode, key: Key, time_ns: int, source: int) -> Sequence[Slice]:
        """Return slices in the order in which they began, but those with all parameters first.

        New slices belong to the host of `source`. `refused` is set if a slice cannot be created.
        """
        self.refused = None
        self.behind = []
        self._now = time_ns
        if self._floating:
            key = of_nan(key)
        domain = _domain(event)
        if domain == self._all:
            known = self._known[domain].slices
            if key in known:
                found = known[key]
                return () if found is None else (self._looked_at(found),)
        size = sum(len(value) for value in key if isinstance(value, bytes))
        if size > MAX_BINDING:
            self._refuse(domain, key, f"a binding of {size} bytes; it may have {MAX_BINDING}")
            return ()
        self._holder = self._holder_of(source)
        whole: list[Slice] = []
        seeds: list[Slice] = []
        for slice_ in (*self._agreeing(domain, key), *self._fresh(event, domain, key)):
            (whole if slice_.domain == self._all else seeds).append(slice_)
        return [*whole, *seeds]

    def _agreeing(self, domain: int, key: Key) -> Iterator[Slice]:
        for other, known in self._known.items():
            if other & domain == domain:
                for known_key in self._with(other, domain, key):
                    found = known.slices[known_key]
                    if found is not None:
                        yield self._looked_at(found)

    def _looked_at(self, slice_: Slice) -> Slice:
        if slice_.due is not None and slice_.due < self._now:
            self.behind.append(slice_)
        return slice_

    def _with(self, domain: int, part: int, key: Key) -> Sequence[Key]:
        known = self._known[domain]
        if part == domain:
            return (key,) if key in known.slices else ()
        return [*known.slices] if not part else [*known.parts[part].get(key, ())]

    def _fresh(self, event: EventCode, domain: int, key: Key) -> list[Slice]:
        own = dict(zip(event.binds, key[1:], strict=True))
        wanted = {(domain, key)} if event.creates and key not in self._known[domain].slices else set()
        order = [*wanted]
        for other in self._known:
            if other & domain == domain:
                continue
            shared = domain & other
            for known_key in self._with(other, shared, _key(own, shared)):
                both = own | dict(zip(_members(other), known_key[1:], strict=True))
                joined = (domain | other, _key(both, domain | other))
                if joined not in wanted and joined[1] not in self._known[joined[0]].slices:
                    wanted.add(joined)
                    order.append(joined)
        found = (self._derive(into, values, len(order)) for into, values in order)
        return [slice_ for slice_ in found if slice_ is not None]

    def _derive(self, domain: int, key: Key, most: int) -> Slice | None:
        values = dict(zip(_members(domain), key[1:], strict=True))
        parent: Slice | None = self._first
        for other in sorted(self._known, key=int.bit_count, reverse=True):
            if other & ~domain or other == domain:
                continue
            part = _key(values, other)
            if part in self._known[other].slices:
                parent = self._known[other].slices[part]
                break
        if parent is None:
            self._remember(domain, key, self._holder)
            return None
        if not self._has_room(most):
            self._refuse(domain, key, self._full())
            return None
        if parent is self._first:
            runs = tuple(
                declared.property.start(self._now) if declared.property.timed else copy(run)
                for declared, run in zip(self._properties, parent.runs, strict=True)
            )
        else:
            runs = tuple(map(self._copy, self._looked_at(parent).runs))
        return Slice(domain, key, runs, parent.values, self._holder)

    def _copy(self, run: Run) -> Run:
        if isinstance(run, BoundedRun):
            self._turn.check(COPY_COST * run.waiting, COPY_COST * run.waiting)
        return copy(run)

    def _full(self) -> str:
        if self._holder is None:
            return f"more than {self.limit} slices"
        held = self.quota.held_by(self._holder)
        return f"its host has {held} of {self.limit} slices, as many as are left for all other hosts"

    def _has_room(self, most: int) -> bool:
        return self.quota.fits(self._holder, most) or (self._forgets and self.quota.held_by(self._holder) > 0)

    def _refuse(self, domain: int, key: Key, why: str) -> None:
        self.refused, self.why = self._shown(domain, key), why

    # The state of the monitor

    def select(self, slice_: Slice) -> tuple[Run, ...]:
        namespace = self._namespace
        if slice_.domain == self._all:
            for (_, code, _), value in zip(self._parameters, slice_.key[1:], strict=True):
                namespace[code] = value
        else:
            bound = dict(zip(_members(slice_.domain), slice_.key[1:], strict=True))
            for number, (_, code, _) in enumerate(self._parameters):
                namespace[code] = bound.get(number, self._first.key[number + 1])
        if self._own:
            namespace.update(zip(self._own, slice_.values, strict=True))
        return slice_.runs

    def own(self) -> tuple[Value, ...]:
        return tuple(self._namespace[name] for name in self._own)

    def settle(
        self, slice_: Slice, runs: tuple[Run, ...], values: tuple[Value, ...], *, happened: bool
    ) -> None:
        """Store the state of a slice. A new slice is kept only if the event with which it begins `happened`."""
        slice_.runs, slice_.values = runs, values
        if slice_.gone:
            return
        self._note(slice_)
        if not slice_.kept:
            if not happened:
                return
            self._keep(slice_)
        if self._lost and all(map(contains, self._lost, _states(runs))):
            self._leave(slice_)
            self._remember(slice_.domain, slice_.key, slice_.holder)
        elif self._renews and slice_.values == self._first.values and all(run.as_new for run in slice_.runs):
            self._leave(slice_)
            self._forget(slice_.domain, slice_.key)
        elif self._timed:
            self._await(slice_)

    def revive(self, slice_: Slice) -> None:
        """Undo the end of a slice whose last deadline is not concluded yet, unless its binding has begun again."""
        self._undo_end(slice_)

    def report_forgotten(self, time_ns: int) -> str:
        """Report the slices forgotten for newer ones of the same host, at most once in `FOLDED_NS`."""
        number = self._forgotten
        if not number or (self._told is not None and time_ns - self._told < FOLDED_NS):
            return ""
        self._forgotten, self._told = 0, time_ns
        return (
            f"{number} of its oldest slices were removed to make room for new ones of the same host; "
            f"the limit is {self.limit} slices"
        )

    # Deadlines

    @property
    def deadline(self) -> int | None:
        while self._deadlines:
            time, _, slice_ = self._deadlines[0]
            if time == slice_.due and not slice_.gone:
                if slice_.deadline == time:
                    return time
                slice_.due = None
                heappop(self._deadlines)
                self._await(slice_)
            elif len(self._deadlines) > 2 * self.live + 64:
                self._tidy()
            else:
                heappop(self._deadlines)
        return None

    @property
    def due(self) -> Slice:
        return self._deadlines[0][2]

    def _await(self, slice_: Slice) -> None:
        deadline = slice_.deadline
        if deadline is None or (slice_.due is not None and slice_.due <= deadline):
            return
        slice_.due, slice_.turn = deadline, next(self._order)
        self._note(slice_)
        heappush(self._deadlines, (deadline, slice_.turn, slice_))
        if len(self._deadlines) > 2 * self.live + 64:
            self._tidy()

    def _tidy(self) -> None:
        self._deadlines = [one for one in self._deadlines if one[0] == one[2].due and not one[2].gone]
        heapify(self._deadlines)

    def restart(self, time_ns: int) -> None:
        self._deadlines.clear()
        for known in self._known.values():
            for slice_ in known.slices.values():
                if slice_ is not None:
                    slice_.due = None
                    self._note(slice_)
                    slice_.runs = tuple(
                        declared.property.start(time_ns) if declared.property.timed else run
                        for declared, run in zip(self._properties, slice_.runs, strict=True)
                    )
                    self._await(slice_)

    # State

    def keep(self) -> None:
        self.changed = {
            (domain, key): None if slice_ is None else slice_.holder
            for domain, known in self._known.items()
            for key, slice_ in known.slices.items()
        }
        for holder, binding in self._ended.all():
            self.changed[binding] = holder

    def _note(self, slice_: Slice) -> None:
        if self.changed is not None:
            self.changed[slice_.domain, slice_.key] = slice_.holder

    @property
    def first(self) -> Slice:
        return self._first

    def state(self, binding: Binding) -> Slice | None:
        """Return None if the slice has ended. Raises `KeyError` for an unknown binding."""
        domain, key = binding
        return self._known[domain].slices[key]

    def restore(
        self,
        zero: Sequence[Value],
        values: Sequence[Value],
        live: Sequence[Slice],
        ended: Sequence[tuple[Binding, Holder]],
    ) -> None:
        """Continue with the slices of another process, in the order in which they began or ended.

        Their keys are made by `of_nan`. Raises `KeyError` for an impossible binding.
        """
        for code, value in zip(self._parameters, zero, strict=True):
            self._namespace[code[1]] = value
        self._namespace.update(zip(self._own, values, strict=True))
        self.begin(self._properties, tuple(declared.property.start(0) for declared in self._properties))
        for slice_ in live:
            slice_.kept = True
            self._put(slice_.domain, slice_.key, slice_)
            self.quota.take(slice_.holder, (slice_.domain, slice_.key))
            if slice_.due is not None:
                self._deadlines.append((slice_.due, slice_.turn, slice_))
        heapify(self._deadlines)
        self._order = count(max((slice_.turn for slice_ in live), default=-1) + 1)
        for (domain, key), holder in ended:
            self._put(domain, key, None)
            self._ended.take(holder, (domain, key))

    # Queries

    def is_whole(self, slice_: Slice) -> bool:
        return slice_.domain == self._all

    def mark(self, slice_: Slice) -> Callable[[], None]:
        """Return a function that undoes later changes to the formulas of a slice, except the passing of time.

        If the slice has only formulas, it also undoes its beginning.
        """
        runs = slice_.runs
        begun = not slice_.kept and all(self._formulas)
        formulas = [
            cast("FormulaRun", run) for run, formula in zip(runs, self._formulas, strict=True) if formula
        ]
        marks = [(run, run.mark()) for run in formulas]

        def take_back() -> None:
            for run, mark in marks:
                run.take_back(mark)
            both = zip(runs, slice_.runs, self._formulas, strict=True)
            slice_.runs = tuple(before if formula else now for before, now, formula in both)
            self._note(slice_)
            if begun and slice_.kept:
                self._undo_end(slice_)
                self._leave(slice_)
                self._forget(slice_.domain, slice_.key)
            elif slice_.kept:
                self._undo_end(slice_)
                self._await(slice_)

        return take_back

    def _undo_end(self, slice_: Slice) -> None:
        if not slice_.gone:
            return
        binding = (slice_.domain, slice_.key)
        known = self._known[slice_.domain].slices
        if known.get(slice_.key) is not None:
            return  # another slice has begun since then
        if slice_.key in known:
            self._ended.give_back(slice_.holder, binding)
        slice_.gone = False
        self.quota.take(slice_.holder, binding)
        self._put(*binding, slice_)

    def values(self, slice_: Slice) -> Mapping[int, Value]:
        return dict(zip(_members(slice_.domain), slice_.key[1:], strict=True))

    def binding(self, slice_: Slice) -> Mapping[str, object]:
        return self._shown(slice_.domain, slice_.key)

    def _shown(self, domain: int, key: Key) -> Mapping[str, object]:
        told = {}
        for number, value in zip(_members(domain), key[1:], strict=True):
            name, _, kind = self._parameters[number]
            told[name] = showing(kind)(value)
        return told

    def _keep(self, slice_: Slice) -> None:
        while not self.quota.fits(slice_.holder, 1):
            domain, key = self.quota.oldest(slice_.holder)
            oldest = self._known[domain].slices[key]
            assert oldest is not None  # noqa: S101  it is live
            self._leave(oldest)
            self._forget(domain, key)
            self._forgotten += 1
        slice_.kept = True
        self.quota.take(slice_.holder, (slice_.domain, slice_.key))
        self._put(slice_.domain, slice_.key, slice_)

    def _leave(self, slice_: Slice) -> None:
        slice_.gone = True
        self.quota.give_back(slice_.holder, (slice_.domain, slice_.key))

    def _put(self, domain: int, key: Key, slice_: Slice | None) -> None:
        known = self._known[domain]
        if key not in known.slices:
            values = dict(zip(_members(domain), key[1:], strict=True))
            for part, keys in known.parts.items():
                keys.setdefault(_key(values, part), {})[key] = None
        known.slices[key] = slice_
        if slice_ is not None:
            self._note(slice_)

    def _remember(self, domain: int, key: Key, holder: Holder) -> None:
        while not self._ended.fits(holder, 1):
            if not self._ended.held_by(holder):
                if key in self._known[domain].slices:
                    self._forget(domain, key)
                return
            oldest = self._ended.oldest(holder)
            self._ended.give_back(holder, oldest)
            self._forget(*oldest)
        self._put(domain, key, None)
        self._ended.take(holder, (domain, key))
        if self.changed is not None:
            self.changed[domain, key] = holder

    def _forget(self, domain: int, key: Key) -> None:
        known = self._known[domain]
        del known.slices[key]
        if self.changed is not None:
            self.changed[domain, key] = None
        values = dict(zip(_members(domain), key[1:], strict=True))
        for part, keys in known.parts.items():
            same = keys[_key(values, part)]
            del same[key]
            if not same:
                del keys[_key(values, part)]


def of_nan(key: Key) -> Key:
    """Return a key in which one object replaces all NaNs, so that the key is found again."""
    return tuple(_NAN if value != value else value for value in key)  # noqa: PLR0124  NaN


def _states(runs: Sequence[Run]) -> list[int]:
    return [run.state for run in runs]  # type: ignore[attr-defined]  # runs over tables


def _domain(event: EventCode) -> int:
    return sum(1 << number for number in event.binds)


def _members(domain: int) -> list[int]:
    return [number for number in range(domain.bit_length()) if domain >> number & 1]


def _key(values: Mapping[int, Value], domain: int) -> Key:
    return (True, *(values[number] for number in _members(domain)))


def _join(domains: Iterator[int]) -> list[int]:
    found: set[int] = set()
    for domain in domains:
        found |= {domain, *(domain | other for other in found)}
    return sorted(found)


def _calm(code: PropertyCode, event: int, lost: frozenset[int], renews: bool) -> list[int]:
    assert isinstance(code.property, FiniteProperty)  # noqa: S101  the caller checks this
    automaton, handled = code.property.automaton, {*code.order}
    return [
        -1
        if row[event] in lost
        or (renews and row[event] == automaton.initial)
        or {*automaton.verdicts[row[event]]} & handled
        else row[event]
        for row in automaton.table
    ]


def _lost(code: PropertyCode) -> frozenset[int]:
    steps = _steps(code.property)
    handled = {*code.order}
    hopeful: set[int] = set()
    while True:
        more = {
            state
            for state, ways in enumerate(steps)
            if state not in hopeful and any(handled & {*told} or target in hopeful for target, told in ways)
        }
        if not more:
            return frozenset(range(len(steps))) - hopeful
        hopeful |= more


def _steps(compiled: CompiledProperty) -> list[list[tuple[int, Categories]]]:
    if isinstance(compiled, FiniteProperty):
        automaton = compiled.automaton
        return [[(target, automaton.verdicts[target]) for target in row] for row in automaton.table]
    assert isinstance(compiled, ClockedProperty)  # noqa: S101  the caller checks this
    verdicts = compiled.verdicts
    steps = []
    for early, late, wait in zip(compiled.moves, compiled.late, compiled.waits, strict=True):
        ways = [(target, verdicts[target]) for target, _ in (*early, *late)]
        steps.append(ways if wait is None else [*ways, (wait.move[0], wait.categories)])
    return steps


def _renews(events: Sequence[EventCode], properties: Sequence[PropertyCode], everything: int) -> bool:
    """Whether a slice in its initial state may be forgotten: each event either creates it or does not change it."""
    return all(
        _domain(event) == everything
        and (event.creates or (event.plain and all(_stays(one, number) for one in properties)))
        for number, event in enumerate(events)
    )


def _stays(code: PropertyCode, event: int) -> bool:
    run = code.property.start(0)
    return run.as_new and {*code.order}.isdisjoint(run.step(event, 0)) and run.as_new
