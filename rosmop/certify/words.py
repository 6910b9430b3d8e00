"""Extended regular expressions by their derivatives (the expression after an event).

Unions and intersections are sets of numbers of expressions, so order and repetition do not matter, and there are
finitely many derivatives (Brzozowski, 1964).
"""

from collections.abc import Iterable

from rosmop.certify.formula_reader import Node, UnsupportedFormulaError, WorkLimitError

LONGEST = 5_000

Parts = tuple[object, ...] | frozenset[int]


class ExpressionDerivatives:
    """Follows an expression; a state is an expression's number. `work` limits the parts of all derivatives together."""

    def __init__(self, expression: Node, work: int) -> None:
        self._work = work
        self._numbers: dict[tuple[str, Parts], int] = {}
        self._all: list[tuple[str, Parts]] = []
        self._matching: list[bool] = []
        self._derived: dict[tuple[int, str], int] = {}
        self._none = self._number("none", (), matches=False)
        self._nothing = self._number("nothing", (), matches=True)
        self._any = self._number("not", (self._none,), matches=True)
        self.initial, _ = self._read(expression)

    def matches(self, state: int) -> bool:
        return self._matching[state]

    def step(self, state: int, event: str) -> int:
        known = self._derived.get((state, event))
        if known is None:
            known = self._derived[state, event] = self._derive(state, event)
        return known

    def _derive(self, state: int, event: str) -> int:
        kind, parts = self._all[state]
        if kind == "event":
            return self._nothing if event in parts else self._none
        numbers = [part for part in parts if isinstance(part, int)]
        after = [self.step(part, event) for part in numbers]
        if kind in ("union", "intersection"):
            return self._several(kind, after)
        if kind == "not":
            return self._not(after[0])
        if kind == "star":
            return self._sequence(after[0], state)
        if kind != "sequence":
            return self._none
        begun = self._sequence(after[0], numbers[1])
        return self._several("union", [begun, after[1]]) if self._matching[numbers[0]] else begun

    def _number(self, kind: str, parts: Parts, *, matches: bool) -> int:
        self._work -= 1 + len(parts)
        if self._work < 0:
            raise WorkLimitError
        number = self._numbers.setdefault((kind, parts), len(self._all))
        if number == len(self._all):
            self._all.append((kind, parts))
            self._matching.append(matches)
        return number

    def _not(self, inner: int) -> int:
        kind, parts = self._all[inner]
        if kind == "not":
            return next(part for part in parts if isinstance(part, int))
        return self._number("not", (inner,), matches=not self._matching[inner])

    def _sequence(self, first: int, rest: int) -> int:
        if self._none in (first, rest):
            return self._none
        if first == self._nothing:
            return rest
        if rest == self._nothing:
            return first
        kind, parts = self._all[first]
        if kind == "sequence":
            head, tail = (part for part in parts if isinstance(part, int))
            return self._sequence(head, self._sequence(tail, rest))
        return self._number("sequence", (first, rest), matches=self._matching[first] and self._matching[rest])

    def _several(self, kind: str, operands: Iterable[int]) -> int:
        neutral, decisive = (self._none, self._any) if kind == "union" else (self._any, self._none)
        flat: set[int] = set()
        for operand in operands:
            of, parts = self._all[operand]
            flat.update(part for part in (parts if of == kind else (operand,)) if isinstance(part, int))
        flat.discard(neutral)
        if decisive in flat:
            return decisive
        if len(flat) < 2:
            return flat.pop() if flat else neutral
        quantor = any if kind == "union" else all
        return self._number(kind, frozenset(flat), matches=quantor(self._matching[part] for part in flat))

    def _read(self, node: Node) -> tuple[int, int]:
        kind = str(node[0])
        if kind == "event":
            return self._number("event", (node[1],), matches=False), 1
        if kind in ("empty", "epsilon"):
            return self._none if kind == "empty" else self._nothing, 1
        read = [self._read(part) for part in node[1:] if isinstance(part, tuple)]
        numbers, size = [number for number, _ in read], sum(size for _, size in read)
        match kind:
            case "power":
                count = int(str(node[2]))
                if count * size > LONGEST:
                    raise UnsupportedFormulaError("its powers are too large")
                power = self._nothing
                for _ in range(count):
                    power = self._sequence(numbers[0], power)
                return power, max(1, count * size)
            case "not":
                number = self._not(numbers[0])
            case "star":
                number = self._number("star", (numbers[0],), matches=True)
            case "sequence":
                number = self._sequence(*numbers)
            case _:
                number = self._several(kind, numbers)
        return number, size
