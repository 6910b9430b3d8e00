"""Parse temporal formulas of ltl, ptltl and mtl, with a table of operators for each logic.

Nesting is bounded, so no walk over a formula can exhaust the stack.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rosmop.logics.interface import Source
from rosmop.logics.lexer import FormulaToken, TokenReader, describe

MAX_NESTING = 100

Bounds = tuple[int, int | None]
"""A closed interval in nanoseconds; None means no upper bound."""

AND = {"and": "and", "&&": "and", "/\\": "and"}
OR = {"or": "or", "||": "or", "\\/": "or"}
XOR = {"xor": "xor", "++": "xor", "^": "xor"}
NOT = {"!": "not", "not": "not"}
IMPLIES = {"=>": "implies", "->": "implies", "implies": "implies", "<=>": "iff", "<->": "iff"}
BOOLEAN_SIGNS = ("(", ")", "!", "&&", "/\\", "||", "\\/", "++", "^", "=>", "->", "<=>", "<->")


@dataclass(frozen=True)
class Formula:
    """A formula. An ``event`` has a ``name``, and a timed operator has ``bounds``."""

    operator: str
    operands: tuple["Formula", ...] = ()
    name: str = ""
    bounds: Bounds | None = None
    offset: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Level:
    """Binary operators of equal precedence, which associate (``flat``), group leftwards, or do not chain (``once``)."""

    operators: Mapping[str, str]
    chain: Literal["flat", "left", "once"]


@dataclass(frozen=True)
class Syntax:
    """The operators of a temporal logic: unary operators bind tightest, then each level of binary operators.

    ``bounded`` operators may be followed by ``[from,to]``.
    """

    unary: Mapping[str, str]
    levels: tuple[Level, ...]
    bounded: frozenset[str] = frozenset()
    refused: Mapping[str, str] = field(default_factory=dict)

    def signs(self) -> list[str]:
        spellings = [*BOOLEAN_SIGNS, "[", "]", ",", *self.unary, *self.refused]
        for level in self.levels:
            spellings += level.operators
        return sorted({text for text in spellings if not text.isidentifier()})


def read_formula(source: Source, syntax: Syntax) -> Formula:
    reader = _FormulaReader(source, syntax)
    formula = reader.formula(0)
    reader.end()
    return formula


def nodes(formula: Formula) -> Iterator[Formula]:
    yield formula
    for operand in formula.operands:
        yield from nodes(operand)


def event_names(formula: Formula) -> list[str]:
    return list(dict.fromkeys(node.name for node in nodes(formula) if node.operator == "event"))


class _FormulaReader:
    def __init__(self, source: Source, syntax: Syntax) -> None:
        self._tokens = TokenReader(source, syntax.signs())
        self._source = source
        self._syntax = syntax
        self._strength = {
            text: number for number, level in enumerate(syntax.levels) for text in level.operators
        }

    def end(self) -> None:
        token = self._tokens.token
        if token.kind != "end":
            self._refuse_foreign(token)
            raise self._tokens.unexpected("an operator or the end of the formula")
        self._tokens.finish()

    def formula(self, depth: int) -> Formula:
        return self._expression(len(self._syntax.levels) - 1, depth)

    def _expression(self, limit: int, depth: int) -> Formula:
        left = self._unary(depth)
        joined = -1
        while (strength := self._strength.get(self._tokens.token.text, limit + 1)) <= limit:
            token = self._tokens.take()
            level = self._syntax.levels[strength]
            if level.chain == "once" and joined == strength:
                raise self._source.error(
                    token.offset,
                    f"`{token.text}` in a chain without parentheses; write which part belongs together",
                )
            operator = level.operators[token.text]
            bounds = self._bounds(operator)
            depth += level.chain == "left"
            right = self._expression(strength - 1, depth + 1)
            grows = level.chain == "flat" and joined == strength
            operands = (*left.operands, right) if grows else (left, right)
            left = Formula(operator, operands, bounds=bounds, offset=left.offset)
            joined = strength
        return left

    def _unary(self, depth: int) -> Formula:
        token = self._tokens.token
        self._check_depth(depth, token)
        if token.text in self._syntax.unary:
            self._tokens.take()
            operator = self._syntax.unary[token.text]
            bounds = self._bounds(operator)
            if self._tokens.token.kind in ("end", ")") and token.text in self._source.events:
                raise self._source.error(
                    token.offset, f"`{token.text}` is an operator of {self._source.logic}; rename the event"
                )
            operand = self._unary(depth + 1)
            return Formula(operator, (operand,), bounds=bounds, offset=token.offset)
        return self._primary(depth)

    def _primary(self, depth: int) -> Formula:
        token = self._tokens.token
        if self._tokens.accept("("):
            inner = self.formula(depth + 1)
            if self._tokens.token.kind != ")":
                self._refuse_foreign(self._tokens.token)
                raise self._tokens.unexpected("`)` or an operator")
            self._tokens.take()
            return inner
        self._refuse_foreign(token)
        if token.kind != "name" or (token.text in self._strength and token.text not in self._source.events):
            raise self._tokens.unexpected("an event, `true`, `false`, `(` or a unary operator")
        self._tokens.take()
        if token.text in ("true", "false"):
            return Formula(token.text, offset=token.offset)
        self._tokens.check_event(token)
        return Formula("event", name=token.text, offset=token.offset)

    def _bounds(self, operator: str) -> Bounds | None:
        if operator not in self._syntax.bounded:
            return None
        opening = self._tokens.token
        if not self._tokens.accept("["):
            return (0, None)
        low = self._tokens.duration("a lower bound")
        self._tokens.expect(",", "`,` and an upper bound")
        high: int | None = None
        if self._tokens.token.text == "inf":
            self._tokens.take()
        else:
            high = self._tokens.duration("an upper bound")
        self._tokens.expect("]", "`]` (bounds are closed)")
        if high is not None and low > high:
            raise self._source.error(
                opening.offset, "the lower bound is above the upper bound (a bare number is seconds)"
            )
        return (low, high)

    def _check_depth(self, depth: int, token: FormulaToken) -> None:
        if depth > MAX_NESTING:
            raise self._source.error(
                token.offset,
                f"nested more than {MAX_NESTING} deep; split the formula into several properties",
            )

    def _refuse_foreign(self, token: FormulaToken) -> None:
        if token.text in self._syntax.refused and token.text not in self._source.events:
            raise self._source.error(token.offset, f"{describe(token)} {self._syntax.refused[token.text]}")


def boolean_levels(temporal: Sequence[Level]) -> tuple[Level, ...]:
    return (*temporal, Level(AND, "flat"), Level(XOR, "flat"), Level(OR, "flat"), Level(IMPLIES, "once"))
