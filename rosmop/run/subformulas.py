"""Find the subformulas that decide a past-time formula over the events of an explanation.

These are few events, so the formula is evaluated by its definition, position by position.
"""

from collections.abc import Callable, Iterator, Sequence

from rosmop.logics import mtl, ptcaret, ptltl
from rosmop.logics.formula import Bounds, Formula, Syntax, nodes, read_formula
from rosmop.logics.interface import Source

_SYNTAXES: dict[str, Syntax] = {"ptltl": ptltl.SYNTAX, "mtl": mtl.SYNTAX, "ptcaret": ptcaret.SYNTAX}
_BOOLEAN: dict[str, Callable[[list[bool]], bool]] = {
    "true": lambda _: True,
    "false": lambda _: False,
    "not": lambda values: not values[0],
    "and": all,
    "or": any,
    "xor": lambda values: sum(values) % 2 == 1,
    "implies": lambda values: not values[0] or values[1],
    "iff": lambda values: values[0] == values[1],
}
_MOST_EVENTS = 24
_MOST = 8


def deciding(source: Source, events: Sequence[int], times: Sequence[int]) -> list[str]:
    """Return the subformulas, or none for other logics and for formulas about the future.

    `events` are numbers in the source, and `times` are in nanoseconds.
    """
    syntax = _SYNTAXES.get(source.logic)
    if syntax is None or not 0 < len(events) <= _MOST_EVENTS:
        return []
    formula = read_formula(source, syntax)
    if any(node.operator in mtl.FUTURE for node in nodes(formula)):
        return []
    words = _Words(syntax)
    meaning = Meaning([source.events[event] for event in events], times)
    last = len(events) - 1
    found = [
        f"{words.text(part)} is {str(value).lower()}" for part, value in _decisive(meaning, formula, last)
    ]
    return list(dict.fromkeys(found))[:_MOST]


def _decisive(meaning: "Meaning", formula: Formula, at: int) -> Iterator[tuple[Formula, bool]]:
    value, operator = meaning.holds(formula, at), formula.operator
    if operator == "not":
        yield from _decisive(meaning, formula.operands[0], at)
    elif operator in ("and", "or", "implies", "xor", "iff"):
        # a true operand decides `or`, a false one `and`; otherwise all decide
        wanted = [
            meaning.holds(part, at) != (operator == "implies" and not number)
            for number, part in enumerate(formula.operands)
        ]
        alone = (operator == "and" and not value) or (operator in ("or", "implies") and value)
        for part, is_so in zip(formula.operands, wanted, strict=True):
            if not alone or is_so == value:
                yield from _decisive(meaning, part, at)
    elif operator not in ("true", "false"):
        yield formula, value


class Meaning:
    """Evaluates formulas at the positions of a trace."""

    def __init__(self, events: Sequence[str], times: Sequence[int]) -> None:
        self._events = events
        self._times = times
        self._abstract = [self._seen(at) for at in range(len(events))]
        self._known: dict[tuple[int, int], bool] = {}
        self._plain: dict[int, Formula] = {}

    def holds(self, formula: Formula, at: int) -> bool:
        key = id(formula), at
        if key not in self._known:
            self._known[key] = self._value(formula, at)
        return self._known[key]

    def _seen(self, at: int) -> list[int]:
        seen: list[int] = []
        for place, event in enumerate(self._events[:at]):
            seen.append(place)
            if event == ptcaret.END:
                open_calls = [
                    number for number, earlier in enumerate(seen) if self._events[earlier] == ptcaret.BEGIN
                ]
                seen = seen[: open_calls[-1]] if open_calls else []
        return [*seen, at]

    def _value(self, formula: Formula, at: int) -> bool:
        operator, operands = formula.operator, formula.operands
        if operator == "event":
            return self._events[at] == formula.name
        if operator in _BOOLEAN:
            return _BOOLEAN[operator]([self.holds(operand, at) for operand in operands])
        if operator.partition(" ")[0] in ("at", "some", "every"):
            return self.holds(self._plain.setdefault(id(formula), ptcaret.plain(formula)), at)
        abstract, dual = operator.startswith("abstract "), operator.startswith("dual ")
        places = self._abstract[at] if abstract else list(range(at + 1))
        return self._past(
            operator.removeprefix("abstract ").removeprefix("dual "), formula, places, dual=dual
        )

    def _past(self, operator: str, formula: Formula, places: list[int], *, dual: bool) -> bool:
        low, high = formula.bounds or (0, None)
        *first, last = formula.operands
        now = self._times[places[-1]]

        def near(place: int) -> bool:
            return now - self._times[place] >= low and (high is None or now - self._times[place] <= high)

        def right(place: int) -> bool:
            return self.holds(last, place) != dual

        if operator == "previously":
            return (len(places) > 1 and near(places[-2]) and right(places[-2])) != dual
        if operator == "historically":
            return all(right(place) for place in places if near(place))
        for place in reversed(places):
            if near(place) and right(place):
                return not dual
            if first and self.holds(first[0], place) == dual:
                break
        return dual


class _Words:
    def __init__(self, syntax: Syntax) -> None:
        levels = [syntax.unary, *(level.operators for level in syntax.levels)]
        self._spelled = {meant: word for words in levels for word, meant in reversed([*words.items()])}

    def text(self, formula: Formula) -> str:
        if not formula.operands:
            return formula.name or formula.operator
        parts = [
            f"({self.text(operand)})" if len(operand.operands) > 1 else self.text(operand)
            for operand in formula.operands
        ]
        word = self._spelled[formula.operator] + _bounds(formula.bounds)
        return f"{word} {parts[0]}" if len(parts) == 1 else f" {word} ".join(parts)


def _bounds(bounds: Bounds | None) -> str:
    if bounds is None:
        return ""
    low, high = bounds
    return f"[{_duration(low)},{'inf' if high is None else _duration(high)}]"


def _duration(nanoseconds: int) -> str:
    for unit, size in (("s", 10**9), ("ms", 10**6), ("us", 10**3)):
        if nanoseconds and not nanoseconds % size:
            return f"{nanoseconds // size}{unit}"
    return f"{nanoseconds}ns"
