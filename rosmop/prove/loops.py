"""Loops of the form and of the module, as one induction over their iterations.

Both sides run through their loops in the same order, so the loops are paired by number. A loop is *cut* at
its head: each slot that an iteration changes gets a new constant there. On the module's side, it is the
constant of the form's variable with the same name. Then one iteration, and the statements after the loop, are
translated once. `loop_conditions` yields the conditions that must not hold; together they are the induction:

- both sides reach the loop, or neither does, and paired slots are equal then;
- if one side begins another iteration, so does the other, and paired slots are equal again;
- each iteration takes something from the budget, so the loop of the form ends.

Names are only a guess of equal slots: a wrong pair leaves a condition that may hold. So a proof holds for any
number of iterations, but a counterexample may be a state that does not occur; `equality.py` then searches for
a difference in `unrolled` loops.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import z3

from rosmop.prove.terms import (
    MIXED,
    Mixed,
    NotProvedError,
    State,
    Term,
    as_bits,
    as_term,
    both,
    either,
    merge,
    opposite,
)
from rosmop.runtime.action_context import BUDGET

BUDGET_SLOT = "budget"


class GrowingList(Protocol):
    """A list that grows during the translation, and whose last entries can be removed."""

    def __len__(self) -> int: ...
    def __delitem__(self, entries: slice, /) -> None: ...


Head = Callable[[int, object, object], object]
"""Takes the loop's number, the slot's name and its value before the loop; returns the value at the head of the loop."""


@dataclass(frozen=True)
class Cut:
    """A loop of one side; `frame` is the call that has the loop.

    `head` has the new constants of the slots that an iteration changes, `entry` their values before the loop, and
    `back` those after an iteration.
    """

    frame: int
    reached: Term
    again: Term
    entry: Mapping[object, object]
    head: Mapping[object, object]
    back: Mapping[object, object]


@dataclass
class Loops:
    """The loops of one side. With `unrolled`, each has at most that many iterations.

    `again` is the condition under which an iteration begins that the translation no longer follows.
    """

    unrolled: int = 0
    cuts: list[Cut] = field(default_factory=list)
    beyond: list[Term] = field(default_factory=list)

    @property
    def again(self) -> Term:
        return either(*(cut.again for cut in self.cuts), *self.beyond)

    def run(
        self,
        state: State,
        body: Callable[[State], tuple[Sequence[State], Sequence[State]]],
        frame: int,
        head: Head,
        logs: Sequence[GrowingList],
    ) -> None:
        """Advance `state` to the end of the loop. A repeated translation removes its earlier entries from `logs`.

        `body` returns the states that begin another iteration, and those that leave the loop.
        """
        left: list[State] = []
        if self.unrolled:
            for _ in range(self.unrolled):
                again, ends = body(state.where(z3.BoolVal(True)))
                left += ends
                state = become(state, again)
            self.beyond.append(state.alive)
        else:
            left += self._cut(state, body, frame, head, [*logs, self.cuts])
        become(state, left)

    def _cut(
        self,
        state: State,
        body: Callable[[State], tuple[Sequence[State], Sequence[State]]],
        frame: int,
        head: Head,
        logs: Sequence[GrowingList],
    ) -> Sequence[State]:
        number, constants = len(self.cuts), dict[object, object]()
        nothing = z3.BoolVal(False)
        self.cuts.append(
            Cut(frame, nothing, nothing, {}, {}, {})
        )  # loops within this one have greater numbers
        while True:
            sizes = [len(log) for log in logs]
            again, left = body(State(state.alive, state.slots | constants))
            back = _join(again)
            changed = {
                key: head(number, key, before)
                for key, before in state.slots.items()
                if key not in constants
                and not z3.is_false(back.alive)
                and not _same(before, back.slots.get(key))
            }
            if not changed:
                break
            constants |= changed
            for log, size in zip(logs, sizes, strict=True):
                del log[size:]
        entry, after = ({key: slots.get(key) for key in constants} for slots in (state.slots, back.slots))
        self.cuts[number] = Cut(frame, state.alive, back.alive, entry, constants, after)
        return left


def loop_conditions(
    form: Sequence[Cut], module: Sequence[Cut], ended: Term, left: Term
) -> Iterator[tuple[str, Term]]:
    """Yield the conditions that z3 must refute. Raises `NotProvedError`.

    `ended` holds if the form faulted or uses something unknown, `left` if the module left the message to
    Python.
    """
    if len(form) != len(module):
        raise NotProvedError("its code has another number of loops")
    for number, (one, other) in enumerate(zip(form, module, strict=True)):
        name = f"loop {number + 1}"
        for text, meant, done in (
            ("is entered", one.reached, other.reached),
            ("goes on", one.again, other.again),
        ):
            yield (
                f"whether {name} {text}",
                either(
                    both(done, opposite(meant), opposite(ended)), both(meant, opposite(done), opposite(left))
                ),
            )
        if BUDGET_SLOT not in one.head:
            if not z3.is_false(one.again):
                raise NotProvedError("not loop-free: it has a loop that costs nothing")
            continue
        entry, head, rest = (as_term(slots[BUDGET_SLOT]) for slots in (one.entry, one.head, one.back))
        yield f"the budget before {name}", both(one.reached, opposite(is_budget(entry)))
        less = both(is_budget(rest), rest < head)
        yield f"the budget after an iteration of {name}", both(one.again, opposite(less))
        for match, key in _pairs(one, other):
            yield (
                f"a variable before {name} ({key})",
                both(one.reached, other.reached, _differ(one.entry[match], other.entry[key])),
            )
            yield (
                f"a variable after an iteration of {name} ({key})",
                both(one.again, other.again, _differ(one.back[match], other.back[key])),
            )


def assumption(form: Sequence[Cut]) -> Sequence[Term]:
    """Return the assumption that the budget at the head of each loop is at most the budget before the loop."""
    bounds = []
    for cut in form:
        if BUDGET_SLOT in cut.head:
            entry, head = (as_term(slots[BUDGET_SLOT]) for slots in (cut.entry, cut.head))
            bounds.append(both(is_budget(head), either(opposite(cut.reached), head <= entry)))
    return bounds


def is_budget(value: Term) -> Term:
    return both(value >= 0, value <= BUDGET)


def _pairs(one: Cut, other: Cut) -> Iterator[tuple[object, object]]:
    """Yield the names of the slots that have the same constant at the heads of both loops."""
    known = {value.get_id(): key for key, value in one.head.items() if isinstance(value, Term)}
    for key, value in other.head.items():
        match = known.get(value.get_id()) if isinstance(value, Term) else None
        if match is not None:
            yield match, key


def _differ(one: object, other: object) -> Term:
    if not isinstance(one, Term) or not isinstance(other, Term):
        return z3.BoolVal(True)
    if z3.is_bool(one) != z3.is_bool(other):
        one, other = (as_bits(value) if z3.is_bool(value) else value for value in (one, other))
    return opposite(one == other)


def constant_for(key: object, value: object) -> Term | Mixed:
    return z3.FreshConst(value.sort(), f"{key} at the head") if isinstance(value, Term) else MIXED


def _same(one: object, other: object) -> bool:
    if isinstance(one, Term) and isinstance(other, Term):
        return one.eq(other)
    return type(one) is type(other) and bool(one == other)


def _join(states: Sequence[State]) -> State:
    alive = [state for state in states if not z3.is_false(state.alive)]
    if not alive:
        return State(z3.BoolVal(False), {})
    end = alive[-1]
    for before in alive[-2::-1]:
        end = State(either(before.alive, end.alive), merge(before.alive, before, end))
    return end


def become(state: State, states: Sequence[State]) -> State:
    end = _join(states)
    state.alive, state.slots = end.alive, end.slots or state.slots
    return state
