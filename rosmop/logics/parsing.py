"""Recognise any context-free grammar: Earley's algorithm with the nullable symbols of Aycock and Horspool.

Instead of the position where it began, an item holds a *continuation*: the items that wait there for its left side to
be completed. So positions are not stored, and an item without a waiting continuation is freed.

- A *frame* is an Earley set: an ``EarleyShape`` (items whose continuations are numbered) and the continuations
  themselves.
- A continuation is a frame and a symbol: the items of that frame's closure that wait for the symbol. None is that of
  the whole trace: its completion means that the trace is in the language.
- If completing a symbol in a frame only completes one of the frame's own continuations, that continuation is used
  instead (Leo, 1991). So right recursion needs neither memory nor time, and LR grammars need constant time per event
  on average.
- Every step that depends on shapes alone is computed once and stored in tables, except for large shapes, which only
  ambiguous grammars have.

Invariants: the continuations of a frame belong to less deep frames, so completing ends. A frame is viable if it has
an item, because every symbol can be completed (``grammar.prepare``).
"""

from collections.abc import Sequence

from rosmop.logics.cfg_grammar import Grammar, nullable_symbols
from rosmop.logics.interface import RunFaultError

MAX_WIDTH = 4_000
"""The most continuations of a frame; only ambiguous grammars come close to it."""
MAX_STEP_WORK = 50_000
MAX_DEPTH = 1_000_000
KEPT_SHAPE_WIDTH = 8
KEPT_SHAPE_ITEMS = 400
KEPT_ENTRIES = 20_000

Entry = tuple[int, int]
"""An item, and a reference: the number of a continuation of the frame, or -1-A for the frame itself and symbol A."""


class EarleyShape:
    """Items with numbered continuations, of which ``done`` are completed."""

    __slots__ = ("done", "items", "kept", "returned", "scanned", "waiters", "width")

    def __init__(self, items: tuple[Entry, ...], done: tuple[int, ...], width: int, *, kept: bool) -> None:
        self.items = items
        self.done = done
        self.width = width
        self.kept = kept
        self.waiters: tuple[dict[int, set[Entry]], dict[int, set[Entry]]] | None = None
        self.scanned: dict[int, Step | None] = {}
        self.returned: dict[int, Step] = {}


Step = tuple[EarleyShape, tuple[int, ...]]


class EarleySet:
    """An Earley set; ``depth`` counts the frames below that wait."""

    __slots__ = ("conts", "depth", "shape")

    def __init__(self, shape: EarleyShape, conts: "Conts", depth: int) -> None:
        self.shape = shape
        self.conts = conts
        self.depth = depth

    def save(self) -> "tuple[Conts, int, EarleyShape]":
        return self.conts, self.depth, self.shape

    def restore(self, saved: "tuple[Conts, int, EarleyShape]") -> None:
        self.conts, self.depth, self.shape = saved

    def resolve(self, references: Sequence[int]) -> "Conts":
        if len(references) == 1:
            only = references[0]
            return (self.conts[only] if only >= 0 else (self, only),)
        conts = self.conts
        return tuple([conts[reference] if reference >= 0 else (self, reference) for reference in references])


Continuation = tuple[EarleySet, int] | None
Conts = tuple[Continuation, ...]


class EarleyRecogniser:
    """The tables of a prepared grammar, filled on demand and shared by all runs."""

    def __init__(self, grammar: Grammar) -> None:
        self.work = 0  # the items of the last step
        self._terminals = grammar.terminals
        self._nullable = nullable_symbols(grammar)
        self._next: list[int] = []
        self._first: dict[int, list[int]] = {}
        for head, body in grammar.rules:
            self._first.setdefault(head, []).append(len(self._next))
            self._next += [*body, -1]
        self._shapes: dict[tuple[tuple[Entry, ...], tuple[int, ...], int], EarleyShape] = {}
        self._joined: dict[tuple[EarleyShape, int, EarleyShape, tuple[int, ...]], Step] = {}
        self._nothing = self._shape((), (), 0)
        start = -1 if grammar.start is None else grammar.start
        item = len(self._next)
        self._next += [start, -1]
        items = ((item, 0),) if grammar.rules and grammar.start is not None else ()
        self.initial = EarleySet(self._shape(items, (), len(items)), (None,) * len(items), 0)

    # ---- one event

    def step(self, frame: EarleySet, event: int) -> tuple[EarleySet, bool] | None:
        """Return the next frame and whether the trace is in the language, or None if no continuation can be in it."""
        self.work = 0
        scanned = self._scan(frame.shape, event)
        if scanned is None:
            return None
        shape, references = scanned
        conts = frame.resolve(references)
        accepted = False
        while shape.done:
            if not shape.kept:
                shape, conts, accepted = self._complete_wide(shape, conts, frame, accepted=accepted)
                break
            index = _deepest(shape.done, conts)
            cont = conts[index]
            if cont is None:
                accepted = True
                shape, conts = self._join(shape, conts, index, self._nothing, ())
                continue
            below, symbol = cont
            returned, references = self._return(below.shape, symbol)
            if not shape.items and len(shape.done) == 1:
                shape, conts = returned, below.resolve(references)
            else:
                shape, conts = self._join(shape, conts, index, returned, below.resolve(references))
        if shape.width > MAX_WIDTH:
            raise RunFaultError(f"the trace can be read in too many ways by this grammar (limit {MAX_WIDTH})")
        depth = 0
        for cont in conts:
            if cont is not None and cont[0].depth >= depth:
                depth = cont[0].depth + 1
        if depth > MAX_DEPTH:
            raise RunFaultError(f"the trace is nested more than {MAX_DEPTH} deep")
        return EarleySet(shape, conts, depth), accepted

    def _complete_wide(
        self, shape: EarleyShape, conts: Conts, before: EarleySet, *, accepted: bool
    ) -> tuple[EarleyShape, Conts, bool]:
        items = {(item, conts[reference]) for item, reference in shape.items}
        waiting = [conts[reference] for reference in shape.done]
        completed = set(waiting)
        while waiting:
            cont = waiting.pop()
            if cont is None:
                accepted = True
                continue
            below, symbol = cont
            returned, references = self._return(below.shape, symbol)
            self.work += len(returned.items) + len(references)
            if self.work > MAX_STEP_WORK:
                raise RunFaultError("the trace can be read in too many ways by this grammar")
            others = below.resolve(references)
            items.update((item, others[reference]) for item, reference in returned.items)
            fresh = {others[reference] for reference in returned.done} - completed
            completed |= fresh
            waiting += fresh
        same = {cont: cont for cont in before.conts}
        number: dict[Continuation, int] = {}
        entries = sorted((item, number.setdefault(cont, len(number))) for item, cont in items)
        chosen = tuple([same.get(cont, cont) for cont in number])
        return self._shape(tuple(entries), (), len(number)), chosen, accepted

    # ---- tables

    def shape(self, items: tuple[Entry, ...], done: tuple[int, ...], width: int) -> EarleyShape:
        return self._shape(items, done, width)

    def _shape(self, items: tuple[Entry, ...], done: tuple[int, ...], width: int) -> EarleyShape:
        if width > KEPT_SHAPE_WIDTH or len(items) > KEPT_SHAPE_ITEMS:
            return EarleyShape(items, done, width, kept=False)
        key = (items, done, width)
        shape = self._shapes.get(key)
        if shape is None:
            if len(self._shapes) >= KEPT_ENTRIES:
                self._shapes.clear()
                self._joined.clear()
            shape = self._shapes[key] = EarleyShape(items, done, width, kept=True)
        return shape

    def _canonical(self, items: set[Entry], done: set[int]) -> Step:
        references = sorted({reference for _, reference in items} | done)
        number = {reference: index for index, reference in enumerate(references)}
        shape = self._shape(
            tuple(sorted((item, number[reference]) for item, reference in items)),
            tuple(sorted(number[reference] for reference in done)),
            len(references),
        )
        return shape, tuple(references)

    def _scan(self, shape: EarleyShape, event: int) -> Step | None:
        known = shape.scanned.get(event, False)
        if known is False:
            _, by_event = self._closure(shape)
            entries = by_event.get(event)
            known = shape.scanned[event] = None if entries is None else self._complete(shape, entries)
        return known  # type: ignore[return-value]  # no longer False

    def _return(self, shape: EarleyShape, reference: int) -> Step:
        known = shape.returned.get(reference)
        if known is None:
            waiters, _ = self._closure(shape)
            known = shape.returned[reference] = self._complete(shape, waiters[-1 - reference])
        return known

    def _closure(self, shape: EarleyShape) -> tuple[dict[int, set[Entry]], dict[int, set[Entry]]]:
        if shape.waiters is not None:
            return shape.waiters
        waiters: dict[int, set[Entry]] = {}
        by_event: dict[int, set[Entry]] = {}
        entries = list(shape.items)
        for item, reference in entries:
            symbol = self._next[item]
            if symbol < self._terminals:
                by_event.setdefault(symbol, set()).add((item + 1, reference))
                continue
            if symbol not in waiters:
                waiters[symbol] = set()
                entries += [
                    (predicted, -1 - symbol)
                    for first in self._first[symbol]
                    for predicted in self._skip_nullable(first)
                    if self._next[predicted] >= 0
                ]
            waiters[symbol].add((item + 1, reference))
        shape.waiters = (waiters, by_event)
        return shape.waiters

    def _skip_nullable(self, item: int) -> list[int]:
        items = [item]
        while self._next[item] in self._nullable:
            item += 1
            items.append(item)
        return items

    def _complete(self, shape: EarleyShape, entries: set[Entry]) -> Step:
        waiters, _ = self._closure(shape)
        items: set[Entry] = set()
        done: set[int] = set()
        completed: set[int] = set()
        waiting = list(entries)
        while waiting:
            item, reference = waiting.pop()
            for further in self._skip_nullable(item):
                if self._next[further] >= 0:
                    items.add((further, reference))
                elif reference >= 0:
                    done.add(reference)
                elif reference not in completed:
                    completed.add(reference)
                    waiting += waiters[-1 - reference]
        aliased = {(item, self._alias(shape, reference)) for item, reference in items}
        return self._canonical(aliased, done)

    def _alias(self, shape: EarleyShape, reference: int) -> int:
        """Return the reference whose completion is the only effect of completing ``reference`` (Leo's rule)."""
        if reference >= 0:
            return reference
        waiters, _ = self._closure(shape)
        seen = {reference}
        while len(waiting := waiters[-1 - reference]) == 1:
            ((item, target),) = waiting
            if self._next[item] >= 0 or target in seen:
                break
            reference = target
            if reference >= 0:
                break
            seen.add(reference)
        return reference

    def _join(
        self, shape: EarleyShape, conts: Conts, index: int, other: EarleyShape, others: Conts
    ) -> tuple[EarleyShape, Conts]:
        place = {cont: number for number, cont in enumerate(conts)}
        mapping = tuple(place.get(cont, -1) for cont in others)
        key = (shape, index, other, mapping)
        known = self._joined.get(key)
        if known is None:
            numbers = [number if number >= 0 else len(conts) + j for j, number in enumerate(mapping)]
            items = {*shape.items, *((item, numbers[reference]) for item, reference in other.items)}
            done = {*shape.done, *(numbers[reference] for reference in other.done)} - {index}
            known = self._canonical(items, done)
            if shape.kept and other.kept:
                if len(self._joined) >= KEPT_ENTRIES:
                    self._joined.clear()
                self._joined[key] = known
        joined, chosen = known
        every = conts + others
        return joined, tuple([every[number] for number in chosen])


def _deepest(done: tuple[int, ...], conts: Conts) -> int:
    deepest, depth = done[0], -2
    if len(done) > 1:
        for index in done:
            cont = conts[index]
            own = -1 if cont is None else cont[0].depth
            if own > depth:
                deepest, depth = index, own
    return deepest
