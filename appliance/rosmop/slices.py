"""The slices of a running parametric specification (Chen and Roşu, "Parametric trace slicing and monitoring", 2012).

A *binding* gives some or all of the parameters a value. The *slice* of a binding are the events that bind nothing else
than it does, from the first on that is a `creation event` (where there is none: from the first on). What is monitored
is each slice whose events bind all parameters: as if the specification stood there for it alone.

Theory of operation:

1. `targets` says which slices an event belongs to: those whose bindings agree with what it binds, joined with it. One
   that is not there yet begins with the state of the largest binding in it that is known; there is one such, because
   with two known bindings that agree what they make together is known, too. Slices that lack a parameter (`seeds`)
   are kept for that, and what their actions and handlers put out is not put out.
2. The engine makes each of them in turn the state of the monitor (`select`), steps it as any other, and takes the state
   back (`settle`): the tables, functions and handlers are the ones of specifications without parameters. Where
   nothing comes of an event but other states of automata, `step` does that.
3. A slice ends, and its ticks with it, when no event can bring it to a handler any more, and no action for a message
   does more than to change its variables.
   Its binding is remembered, so that none begins anew with it: of so many bindings as there may be slices, then the
   one that ended first is forgotten. One that is as at its beginning, and would begin with any event that matters to
   it, is forgotten at once: nobody can tell.
4. There are never more than `limit` slices, and no binding has more than `MAX_BINDING` bytes. What would be beyond is
   `refused`: a fault, and no slice; those that are there go on.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from itertools import repeat
from operator import contains, getitem
from typing import Any, cast

from appliance.rosmop.compiled import EventCode, PropertyCode, SpecificationCode
from appliance.rosmop.ir.sites import showing
from appliance.rosmop.logics.interface import FiniteProperty, FormulaRun, Run
from appliance.rosmop.types import kinds

LIMIT = 100_000
"""Slices of one specification, unless it is set otherwise."""

GROWING_LIMIT = 1_000
"""The same where a run is more than the state of an automaton (`cfg`, `srs`, `ptcaret`), and may grow."""

MAX_BINDING = 256
"""Bytes of the strings in a binding."""

Key = tuple[Any, ...]
"""A binding: True, and the values of the parameters that it has, in their order."""

_NAN = float("nan")  # one is found again, though it is not equal to itself


@dataclass(eq=False, slots=True)
class Slice:
    """One slice: which parameters its binding has (a set of bits), their values, and its state."""

    domain: int
    key: Key
    runs: tuple[Run, ...]
    values: tuple[Any, ...]
    kept: bool = False

    def stand(self, states: Sequence[int]) -> None:
        """Its automata are in these states."""
        for run, state in zip(self.runs, states, strict=True):
            run.state = state  # type: ignore[attr-defined]  # of tables


@dataclass(eq=False, slots=True)
class _Known:
    """The slices whose bindings have the same parameters; None for one that has ended.

    `parts` has the keys again by the values of some of the parameters, for each set of parameters that is asked for.
    """

    slices: dict[Key, Slice | None] = field(default_factory=dict)
    parts: dict[int, dict[Key, dict[Key, None]]] = field(default_factory=dict)


class Slices:
    """All slices of one specification."""

    def __init__(self, code: SpecificationCode, namespace: dict[str, Any], limit: int) -> None:
        assert code.slicing is not None  # noqa: S101  who asks has looked
        grows = any(not isinstance(declared.property, FiniteProperty) for declared in code.properties)
        self.limit = min(limit, GROWING_LIMIT) if grows else limit
        self.refused: Mapping[str, object] | None = None
        """What the last event bound of which there can be no slice."""
        self.why = ""
        """Why not."""
        self.live = 0
        """Slices, also such that lack a parameter."""
        self._code = code
        self._namespace = namespace
        self._parameters = code.slicing.parameters
        self._own = code.slicing.own
        self._all = (1 << len(self._parameters)) - 1
        self._floating = any(isinstance(kind, kinds.Floating) for _, _, kind in self._parameters)
        self._first: Slice
        self._known = {domain: _Known() for domain in _joined(_domain(event) for event in code.events)}
        self._ended: deque[tuple[int, Key]] = deque()
        self._whole = self._known[self._all].slices
        self._formulas = [declared.property.suppresses for declared in code.properties]
        self._look_at(code.properties)
        for wanted in {_domain(event) for event in code.events}:
            for domain, known in self._known.items():
                if wanted & domain not in (0, domain):
                    known.parts.setdefault(wanted & domain, {})

    def _look_at(self, properties: Sequence[PropertyCode]) -> None:
        """Find out in which states of automata a slice is over, as if there were none, or nothing but a state."""
        events = self._code.events
        finite = [declared for declared in properties if isinstance(declared.property, FiniteProperty)]
        every = len(finite) == len(properties)
        ends = every and bool(finite) and not any(event.acts for event in events if event.period_ns is None)
        self._lost = [_lost(declared) for declared in finite] if ends else []
        self._idles = _idles(events, finite, self._all) if every and finite else None
        lost = self._lost or [frozenset()] * len(finite)
        idles = self._idles or [-1] * len(finite)
        self._calm = [
            [*map(_calm, finite, repeat(number), lost, idles)]
            if every and event.plain and _domain(event) == self._all
            else None
            for number, event in enumerate(events)
        ]

    def begin(self, properties: Sequence[PropertyCode], runs: tuple[Run, ...]) -> None:
        """The specification begins: there are no slices, and the next ones begin as it has."""
        self._look_at(properties)
        zero = tuple(self._namespace[code] for _, code, _ in self._parameters)
        values = tuple(self._namespace[name] for name in self._own)
        self._first = Slice(0, (True, *zero), runs, values)
        self._ended.clear()
        self.live = 0
        for known in self._known.values():
            known.slices.clear()
            for part in known.parts.values():
                part.clear()

    def take_over(self, before: "Slices") -> None:
        """Go on with those of the same specification before it was loaded again."""
        self._first, self._known, self._ended, self.live = (
            before._first,
            before._known,
            before._ended,
            before.live,
        )
        self._whole = before._whole

    # What an event belongs to

    def step(self, event: int, key: Key) -> bool | None:
        """Step the one slice that an event binds all parameters of, if nothing comes of it but states.

        Whether it has happened (not where the slice is over); None: there is more to do, and nothing is done.
        """
        if key not in self._whole:
            return None
        slice_, calm = self._whole[key], self._calm[event]
        if slice_ is None or calm is None:
            return False if slice_ is None else None
        if len(calm) == 1:  # as below, for most
            run: Any = slice_.runs[0]
            state = calm[0][run.state]
            if state < 0:
                return None
            run.state = state
            return True
        after = [*map(getitem, calm, _states(slice_.runs))]
        if min(after, default=0) >= 0:
            slice_.stand(after)
            return True
        return None

    def at(self, key: Key) -> Slice | None:
        """The slice of all parameters with this key, if there is one."""
        return self._whole.get(key)

    def targets(self, event: EventCode, key: Key) -> tuple[Sequence[Slice], Sequence[Slice]]:
        """The slices with all parameters that an event belongs to, in the order in which they began, and the others.

        `refused` says afterwards whether there would be more of them.
        """
        self.refused = None
        if self._floating:
            key = tuple(_NAN if value != value else value for value in key)  # noqa: PLR0124  NaN
        domain = _domain(event)
        if domain == self._all:
            known = self._known[domain].slices
            if key in known:
                found = known[key]
                return () if found is None else (found,), ()
        size = sum(len(value) for value in key if isinstance(value, bytes))
        if size > MAX_BINDING:
            self._refuse(domain, key, f"a binding of {size} bytes; it may have {MAX_BINDING}")
            return (), ()
        whole: list[Slice] = []
        seeds: list[Slice] = []
        for slice_ in (*self._agreeing(domain, key), *self._fresh(event, domain, key)):
            (whole if slice_.domain == self._all else seeds).append(slice_)
        return whole, seeds

    def _agreeing(self, domain: int, key: Key) -> Iterator[Slice]:
        """The slices that bind what the event binds, with the same values."""
        for other, known in self._known.items():
            if other & domain == domain:
                for known_key in self._with(other, domain, key):
                    found = known.slices[known_key]
                    if found is not None:
                        yield found

    def _with(self, domain: int, part: int, key: Key) -> Sequence[Key]:
        """The keys of this domain that have these values of the parameters in `part`."""
        known = self._known[domain]
        if part == domain:
            return (key,) if key in known.slices else ()
        return [*known.slices] if not part else [*known.parts[part].get(key, ())]

    def _fresh(self, event: EventCode, domain: int, key: Key) -> list[Slice]:
        """Those that begin with this event."""
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
        found = (self._derived(into, values, len(order)) for into, values in order)
        return [slice_ for slice_ in found if slice_ is not None]

    def _derived(self, domain: int, key: Key, most: int) -> Slice | None:
        """A slice with the state of the largest binding in this one that is known; None if that has ended."""
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
            self._remember(domain, key)
            return None
        if self.live + most > self.limit:
            self._refuse(domain, key, f"more than {self.limit} slices")
            return None
        return Slice(domain, key, tuple(map(copy, parent.runs)), parent.values)

    def _refuse(self, domain: int, key: Key, why: str) -> None:
        self.refused, self.why = self._shown(domain, key), why

    # The state of the monitor

    def select(self, slice_: Slice) -> tuple[Run, ...]:
        """Give the variables the values that they have in this slice; its runs, for the properties."""
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

    def settle(self, slice_: Slice, runs: tuple[Run, ...], *, happened: bool) -> None:
        """Take the state back; one that has begun with this event stays only if it `happened`."""
        if self._own:
            slice_.values = tuple(self._namespace[name] for name in self._own)
        slice_.runs = runs
        if not slice_.kept:
            if not happened:
                return
            self._keep(slice_)
        if self._lost and all(map(contains, self._lost, _states(runs))):
            self._remember(slice_.domain, slice_.key)
            self.live -= 1
        elif self._idles is not None and slice_.values == self._first.values and self._idles == _states(runs):
            self._forget(slice_.domain, slice_.key)
            self.live -= 1

    def mark(self, slice_: Slice) -> Callable[[], None]:
        """Return what takes back all that comes to the formulas of a slice from here on, but time; one that begins
        with the message at hand has not begun, if there are only formulas.
        """
        runs, known = slice_.runs, self._known[slice_.domain].slices
        begun = not slice_.kept and bool(runs) and all(self._formulas)
        formulas = [
            cast("FormulaRun", run) for run, formula in zip(runs, self._formulas, strict=True) if formula
        ]
        marks = [(run, run.mark()) for run in formulas]

        def take_back() -> None:
            for run, mark in marks:
                run.take_back(mark)
            both = zip(runs, slice_.runs, self._formulas, strict=True)
            slice_.runs = tuple(before if formula else now for before, now, formula in both)
            there, ended = slice_.key in known, known.get(slice_.key, slice_) is None
            if begun:
                if there:
                    self.live -= not ended
                    self._forget(slice_.domain, slice_.key)
            elif not there or ended:
                self.live += 1
                self._put(slice_.domain, slice_.key, slice_)
            if ended:
                self._ended.remove((slice_.domain, slice_.key))

        return take_back

    def values(self, slice_: Slice) -> Mapping[int, Any]:
        """The values of the parameters, by their numbers."""
        return dict(zip(_members(slice_.domain), slice_.key[1:], strict=True))

    def binding(self, slice_: Slice) -> Mapping[str, object]:
        """The values of the parameters, as they are told."""
        return self._shown(slice_.domain, slice_.key)

    def _shown(self, domain: int, key: Key) -> Mapping[str, object]:
        told = {}
        for number, value in zip(_members(domain), key[1:], strict=True):
            name, _, kind = self._parameters[number]
            told[name] = showing(kind)(value)
        return told

    def _keep(self, slice_: Slice) -> None:
        slice_.kept = True
        self.live += 1
        self._put(slice_.domain, slice_.key, slice_)

    def _put(self, domain: int, key: Key, slice_: Slice | None) -> None:
        known = self._known[domain]
        if key not in known.slices:
            values = dict(zip(_members(domain), key[1:], strict=True))
            for part, keys in known.parts.items():
                keys.setdefault(_key(values, part), {})[key] = None
        known.slices[key] = slice_

    def _remember(self, domain: int, key: Key) -> None:
        """No slice begins with this binding."""
        self._put(domain, key, None)
        self._ended.append((domain, key))
        if len(self._ended) > self.limit:
            self._forget(*self._ended.popleft())

    def _forget(self, domain: int, key: Key) -> None:
        known = self._known[domain]
        del known.slices[key]
        values = dict(zip(_members(domain), key[1:], strict=True))
        for part, keys in known.parts.items():
            same = keys[_key(values, part)]
            del same[key]
            if not same:
                del keys[_key(values, part)]


def _states(runs: Sequence[Run]) -> list[int]:
    """Those of automata."""
    return [run.state for run in runs]  # type: ignore[attr-defined]  # of tables


def _domain(event: EventCode) -> int:
    return sum(1 << number for number in event.binds)


def _members(domain: int) -> list[int]:
    return [number for number in range(domain.bit_length()) if domain >> number & 1]


def _key(values: Mapping[int, Any], domain: int) -> Key:
    return (True, *(values[number] for number in _members(domain)))


def _joined(domains: Iterator[int]) -> list[int]:
    """What bindings can have: the parameters of one event, or of several together."""
    found: set[int] = set()
    for domain in domains:
        found |= {domain, *(domain | other for other in found)}
    return sorted(found)


def _calm(code: PropertyCode, event: int, lost: frozenset[int], idle: int) -> list[int]:
    """The state after an event for each state; -1 where a handler runs, or the slice may be over."""
    assert isinstance(code.property, FiniteProperty)  # noqa: S101  who asks has looked
    automaton, handled = code.property.automaton, {*code.order}
    return [
        -1
        if row[event] in lost or row[event] == idle or {*automaton.verdicts[row[event]]} & handled
        else row[event]
        for row in automaton.table
    ]


def _lost(code: PropertyCode) -> frozenset[int]:
    """The states from which no event leads to a handler any more, now or later."""
    assert isinstance(code.property, FiniteProperty)  # noqa: S101  who asks has looked
    automaton = code.property.automaton
    hopeful: set[int] = set()
    told = {state for state, verdicts in enumerate(automaton.verdicts) if {*verdicts} & {*code.order}}
    while True:
        more = {
            state
            for state, row in enumerate(automaton.table)
            if state not in hopeful and any(target in told or target in hopeful for target in row)
        }
        if not more:
            return frozenset(range(len(automaton))) - hopeful
        hopeful |= more


def _idles(
    events: Sequence[EventCode], properties: Sequence[PropertyCode], everything: int
) -> list[int] | None:
    """The states of the properties in which a slice is as if there were none; None if that cannot be."""
    automata = [
        (declared.property.automaton, {*declared.order})
        for declared in properties
        if isinstance(declared.property, FiniteProperty)
    ]
    initial = [automaton.initial for automaton, _ in automata]
    for number, event in enumerate(events):
        stays = event.plain and all(
            automaton.table[automaton.initial][number] == automaton.initial
            and handled.isdisjoint(automaton.verdicts[automaton.initial])
            for automaton, handled in automata
        )
        if _domain(event) != everything or not (event.creates or stays):
            return None
    return initial
