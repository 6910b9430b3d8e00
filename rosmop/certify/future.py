"""Formulas about the future, over endless traces.

A state is the remaining obligation: *clauses*, of which one must come true. A clause is a set of temporal
parts of the formula, all of which must come true. A clause that requires more than another clause is left
out, so there are finitely many states. The remainder after an event follows from the definition: `x U y` is
`y`, or else `x` now and `x U y` at the next event. A clause can come true if its paths reach a cycle on which
no `until` is postponed at every step.
"""

from collections.abc import Sequence

from rosmop.certify.formula_reader import Node, WorkLimitError

Clause = frozenset[Node]
State = frozenset[Clause]
Way = tuple[Clause, frozenset[Node]]
"""One step from a clause: the remainder, and each `until` that the step postpones."""

TRUE: State = frozenset([frozenset()])
FALSE: State = frozenset()


class FutureFollower:
    """Follows a formula over numbered letters, one at each position. Raises `WorkLimitError` above `work` clauses."""

    def __init__(self, letters: int, work: int) -> None:
        self._letters = range(letters)
        self._work = work
        self._left: dict[tuple[Node, int], State] = {}
        self._known: dict[Clause, bool] = {}

    def start(self, formula: Node) -> State:
        return self._now(formula)

    def step(self, state: State, letter: int) -> State:
        return self._any([self._after(clause, letter) for clause in state])

    def steps(self, state: State, letters: Sequence[int]) -> State:
        self._work -= len(letters)
        return self._any(
            [self._after(clause, letter) for clause in state for letter in self._among(clause, letters)]
        )

    def possible(self, state: State) -> bool:
        return any(self._possible(clause) for clause in state)

    def _among(self, clause: Clause, letters: Sequence[int]) -> list[int]:
        masks = [part[1] for part in clause if part[0] == "one of"]
        return [letter for letter in letters if all(mask >> letter & 1 for mask in masks)]  # type: ignore[operator]  # sets of letters

    # --- the remaining obligation ---

    def _after(self, clause: Clause, letter: int) -> State:
        left = [self._part_after(part, letter) for part in clause]
        return FALSE if FALSE in left else self._all(left)

    def _part_after(self, part: Node, letter: int) -> State:
        key = part, letter
        if key not in self._left:
            self._left[key] = self._define(part, letter)
        return self._left[key]

    def _define(self, part: Node, letter: int) -> State:
        operator, operands = part[0], part[1:]
        if operator == "one of":
            return TRUE if operands[0] >> letter & 1 else FALSE  # type: ignore[operator]  # a set of letters
        first: Node = operands[0]  # type: ignore[assignment]  # a formula
        if operator == "next":
            return self._now(first)
        second: Node = operands[1]  # type: ignore[assignment]  # a formula
        again: State = frozenset([frozenset([part])])
        if operator == "until":
            return self._any([self._at(second, letter), self._all([self._at(first, letter), again])])
        return self._all([self._at(second, letter), self._any([self._at(first, letter), again])])

    def _at(self, formula: Node, letter: int) -> State:
        return self.step(self._now(formula), letter)

    def _now(self, formula: Node) -> State:
        operator, operands = formula[0], formula[1:]
        if operator == "and":
            return self._all([self._now(operand) for operand in operands])  # type: ignore[arg-type]  # formulas
        if operator == "or":
            return self._any([self._now(operand) for operand in operands])  # type: ignore[arg-type]  # formulas
        if operator == "one of" and operands[0] in (0, (1 << len(self._letters)) - 1):
            return TRUE if operands[0] else FALSE
        return frozenset([frozenset([formula])])

    def _any(self, states: list[State]) -> State:
        return self._least({clause for state in states for clause in state})

    def _all(self, states: list[State]) -> State:
        together: set[Clause] = {frozenset()}
        for state in states:
            together = set(self._least({guess | other for guess in together for other in state}))
        return frozenset(together)

    def _least(self, clauses: set[Clause]) -> State:
        self._work -= len(clauses)
        if self._work < 0:
            raise WorkLimitError
        ordered = sorted(clauses, key=len)
        kept: list[Clause] = []
        for clause in ordered:
            if not any(other <= clause for other in kept):
                kept.append(clause)
        self._work -= len(kept)
        return frozenset(kept)

    # --- whether it can come true ---

    def _possible(self, clause: Clause) -> bool:
        if clause not in self._known:
            self._explore(clause)
        return self._known[clause]

    def _explore(self, start: Clause) -> None:
        ways: dict[Clause, set[Way]] = {}
        waiting = [start]
        while waiting:
            clause = waiting.pop()
            if clause not in ways:
                ways[clause] = {
                    way for letter in self._among(clause, self._letters) for way in self._ways(clause, letter)
                }
                waiting += [after for after, _ in ways[clause]]
        good = {clause for clause in ways if self._known.get(clause, False)}
        for group in _circles(ways):
            if _fulfils(group, ways):
                good |= group
        leading: dict[Clause, set[Clause]] = {}
        for clause, ways_on in ways.items():
            for after, _ in ways_on:
                leading.setdefault(after, set()).add(clause)
        waiting = list(good)
        while waiting:
            for before in leading.get(waiting.pop(), ()):
                if before not in good:
                    good.add(before)
                    waiting.append(before)
        self._known.update({clause: clause in good for clause in ways})

    def _ways(self, clause: Clause, letter: int) -> set[Way]:
        left = [(part, self._part_after(part, letter)) for part in clause]
        self._work -= 1
        if any(state == FALSE for _, state in left):
            return set()
        ways: set[Way] = {(frozenset(), frozenset())}
        for part, state in left:
            found = {
                (after | more, off | {part} if part[0] == "until" and part in more else off)
                for after, off in ways
                for more in state
            }
            self._work -= len(found)
            if self._work < 0:
                raise WorkLimitError
            ways = {
                way
                for way in found
                if not any(other != way and other[0] <= way[0] and other[1] <= way[1] for other in found)
            }
        return ways


def _fulfils(group: set[Clause], ways: dict[Clause, set[Way]]) -> bool:
    inside = [off for clause in group for after, off in ways[clause] if after in group]
    return bool(inside) and not frozenset.intersection(*inside)


def _circles(ways: dict[Clause, set[Way]]) -> list[set[Clause]]:
    order: list[Clause] = []
    seen: set[Clause] = set()
    for root in ways:
        waiting = [(root, False)]
        while waiting:
            clause, done = waiting.pop()
            if done:
                order.append(clause)
            elif clause not in seen:
                seen.add(clause)
                waiting.append((clause, True))
                waiting += [(after, False) for after, _ in ways[clause] if after not in seen]
    back: dict[Clause, list[Clause]] = {clause: [] for clause in ways}
    for clause, ways_on in ways.items():
        for after, _ in ways_on:
            back[after].append(clause)
    groups: list[set[Clause]] = []
    placed: set[Clause] = set()
    for root in reversed(order):
        group: set[Clause] = set()
        stack = [root]
        while stack:
            clause = stack.pop()
            if clause not in placed:
                placed.add(clause)
                group.add(clause)
                stack += back[clause]
        if group:
            groups.append(group)
    return groups


def positive(formula: Node, letters: int, *, wanted: bool = True) -> Node:
    """Return the formula (or its negation) using only `one of`, `and`, `or`, `next`, `until` and `release`.

    A `one of` names its letters by a set of bits.
    """
    operator, everything = formula[0], (1 << letters) - 1
    if operator in ("one of", "true", "false"):
        holds = formula[1] if operator == "one of" else everything if operator == "true" else 0
        assert isinstance(holds, int)  # noqa: S101  a set of letters
        return ("one of", holds if wanted else everything & ~holds)
    first: Node = formula[1]  # type: ignore[assignment]  # a formula
    if operator == "not":
        return positive(first, letters, wanted=not wanted)
    if operator == "next":
        return ("next", positive(first, letters, wanted=wanted))
    always, never = ("one of", everything), ("one of", 0)
    if operator in ("always", "eventually"):
        strong = (operator == "eventually") is wanted
        inner = positive(first, letters, wanted=wanted)
        return ("until", always, inner) if strong else ("release", never, inner)
    second: Node = formula[2]  # type: ignore[assignment]  # a formula
    if operator in ("xor", "iff"):
        same = (operator == "iff") is wanted
        both = [positive(first, letters), positive(second, letters, wanted=same)]
        none = [positive(first, letters, wanted=False), positive(second, letters, wanted=not same)]
        return ("or", ("and", *both), ("and", *none))
    left = positive(first, letters, wanted=wanted is not (operator == "implies"))
    right = positive(second, letters, wanted=wanted)
    dual = {"and": "or", "or": "and", "implies": "and", "until": "release", "release": "until"}
    plain = "or" if operator == "implies" else str(operator)
    return (plain if wanted else dual[str(operator)], left, right)
