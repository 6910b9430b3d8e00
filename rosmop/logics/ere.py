"""``ere``: extended regular expressions, as MOP's ERE plugin reads them.

The states are Brzozowski's derivatives. Expressions that are equal by associativity, commutativity and idempotence of
union and intersection are stored once, so their number is finite.
"""

from dataclasses import dataclass

from rosmop.logics.automaton import Automaton, TooManyStatesError, explore, letter_classes, spread
from rosmop.logics.formula import MAX_NESTING
from rosmop.logics.interface import FiniteProperty, Source
from rosmop.logics.lexer import TokenReader

MAX_SYMBOLS = 5_000
MAX_WORK = 8_000_000


class TooMuchWorkError(Exception):
    """The derivatives of an expression take too much work."""


@dataclass(frozen=True)
class RegularExpression:
    """An interned expression. ``parts`` are the numbers of its operands, or the letter of a symbol."""

    kind: str
    parts: tuple[int, ...]
    nullable: bool
    size: int


class ExpressionTable:
    """Stores each expression once, with its derivatives."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[str, tuple[int, ...]], int] = {}
        self._all: list[RegularExpression] = []
        self._derived: dict[tuple[int, int], int] = {}
        self._work = 0
        self.empty = self._intern("empty", (), nullable=False)
        self.epsilon = self._intern("epsilon", (), nullable=True)
        self.anything = self._intern("not", (self.empty,), nullable=True)

    def __getitem__(self, number: int) -> RegularExpression:
        return self._all[number]

    def _intern(self, kind: str, parts: tuple[int, ...], *, nullable: bool) -> int:
        number = self._numbers.get((kind, parts))
        if number is None:
            number = self._numbers[kind, parts] = len(self._all)
            size = 1 if kind == "symbol" else 1 + sum(self._all[part].size for part in parts)
            self._all.append(RegularExpression(kind, parts, nullable, size))
        self._work += len(parts) + 1
        if self._work > MAX_WORK:
            raise TooMuchWorkError
        return number

    def symbol(self, letter: int) -> int:
        return self._intern("symbol", (letter,), nullable=False)

    def complement(self, inner: int) -> int:
        expression = self._all[inner]
        if expression.kind == "not":
            return expression.parts[0]
        return self._intern("not", (inner,), nullable=not expression.nullable)

    def star(self, inner: int) -> int:
        if inner in (self.empty, self.epsilon):
            return self.epsilon
        if inner == self.anything or self._all[inner].kind == "star":
            return inner
        return self._intern("star", (inner,), nullable=True)

    def sequence(self, factors: list[int]) -> int:
        flat: list[int] = []
        for factor in factors:
            expression = self._all[factor]
            if factor == self.empty:
                return self.empty
            if expression.kind == "sequence":
                flat += expression.parts
            elif factor != self.epsilon:
                flat.append(factor)
        if len(flat) < 2:
            return flat[0] if flat else self.epsilon
        return self._intern(
            "sequence", tuple(flat), nullable=all(self._all[factor].nullable for factor in flat)
        )

    def join(self, kind: str, operands: list[int]) -> int:
        neutral, absorbing, quantor = self.empty, self.anything, any
        if kind == "intersection":
            neutral, absorbing, quantor = self.anything, self.empty, all
        flat: set[int] = set()
        for operand in operands:
            expression = self._all[operand]
            flat.update(expression.parts if expression.kind == kind else (operand,))
        flat.discard(neutral)
        if absorbing in flat:
            return absorbing
        if len(flat) < 2:
            return flat.pop() if flat else neutral
        nullable = quantor(self._all[part].nullable for part in flat)
        return self._intern(kind, tuple(sorted(flat)), nullable=nullable)

    def derivative(self, number: int, letter: int) -> int:
        known = self._derived.get((number, letter))
        if known is None:
            known = self._derived[number, letter] = self._derive(self._all[number], letter)
        return known

    def _derive(self, expression: RegularExpression, letter: int) -> int:
        kind, parts = expression.kind, expression.parts
        if kind == "symbol":
            return self.epsilon if parts[0] == letter else self.empty
        if kind in ("empty", "epsilon"):
            return self.empty
        if kind == "star":
            return self.sequence([self.derivative(parts[0], letter), self._numbers["star", parts]])
        if kind == "not":
            return self.complement(self.derivative(parts[0], letter))
        derived = []
        for index, part in enumerate(parts):
            step = self.derivative(part, letter)
            if kind != "sequence":
                derived.append(step)
                continue
            if step != self.empty:
                derived.append(self.sequence([step, *parts[index + 1 :]]))
            if not self._all[part].nullable:
                break
        return self.join("union" if kind == "sequence" else kind, derived)


def compile_ere(source: Source) -> FiniteProperty:
    reader = _ExpressionReader(source)
    automaton = _match_automaton(source, reader)
    return FiniteProperty(source, ("match", "fail"), with_fail(automaton))


def _match_automaton(source: Source, reader: "_ExpressionReader") -> Automaton:
    arena = reader.arena
    try:
        whole = reader.whole()
        of_event, _ = letter_classes(source.events, reader.letters)
        kinds = sorted(set(of_event))
        first = [of_event.index(kind) for kind in kinds]
        numbers = {name: number for number, name in enumerate(reader.letters)}
        letters = [numbers.get(source.events[index], -1) for index in first]
        automaton = explore(
            whole,
            len(letters),
            lambda state, kind: arena.derivative(state, letters[kind]),
            lambda state: ("match",) if arena[state].nullable else (),
        )
    except TooManyStatesError as error:
        raise source.error(0, f"the monitor of this expression has {error}; write a smaller one") from None
    except TooMuchWorkError:
        raise source.error(
            0, "the monitor of this expression is too large to build; write a smaller one"
        ) from None
    return spread(automaton, of_event)


def with_fail(automaton: Automaton) -> Automaton:
    verdicts = tuple(
        ("fail",) if not verdict and all(target == state for target in row) else verdict
        for state, (row, verdict) in enumerate(zip(automaton.table, automaton.verdicts, strict=True))
    )
    return Automaton(automaton.initial, automaton.table, verdicts, automaton.names)


class _ExpressionReader:
    def __init__(self, source: Source) -> None:
        self._tokens = TokenReader(source, ("|", "&", "~", "*", "+", "^", "(", ")", "?", "||", "&&", "!"))
        self._source = source
        self._letters: dict[str, int] = {}
        self.arena = ExpressionTable()

    @property
    def letters(self) -> list[str]:
        return list(self._letters)

    def whole(self) -> int:
        number = self._union(0)
        if self._tokens.token.kind != "end":
            raise self._unexpected("an operator or the end of the expression")
        self._tokens.finish()
        return number

    def _union(self, depth: int) -> int:
        operands = [self._intersection(depth)]
        while self._tokens.accept("|"):
            operands.append(self._intersection(depth))
        return self.arena.join("union", operands)

    def _intersection(self, depth: int) -> int:
        operands = [self._sequence(depth)]
        while self._tokens.accept("&"):
            operands.append(self._sequence(depth))
        return self.arena.join("intersection", operands)

    def _sequence(self, depth: int) -> int:
        factors = [self._unary(depth)]
        while self._tokens.token.kind in ("name", "(", "~"):
            factors.append(self._unary(depth))
        return self._bounded(self.arena.sequence(factors))

    def _unary(self, depth: int) -> int:
        if depth > MAX_NESTING:
            raise self._source.error(
                self._tokens.token.offset, f"nested more than {MAX_NESTING} deep; write a flatter expression"
            )
        if self._tokens.accept("~"):
            return self.arena.complement(self._unary(depth + 1))
        number = self._primary(depth)
        while self._tokens.token.kind in ("*", "+", "^"):
            number = self._suffix(number)
        return number

    def _suffix(self, number: int) -> int:
        sign = self._tokens.take()
        if sign.kind == "*":
            return self.arena.star(number)
        if sign.kind == "+":
            return self.arena.sequence([number, self.arena.star(number)])
        count = self._tokens.expect("number", "a whole number after `^`")
        if not count.text.isdigit() or len(count.text) > 6:
            raise self._source.error(count.offset, "a power must be a whole number below a million")
        power = int(count.text)
        if power * self.arena[number].size > MAX_SYMBOLS:
            raise self._source.error(
                sign.offset, f"written out, this power has more than {MAX_SYMBOLS} symbols"
            )
        return self.arena.sequence([number] * power)

    def _primary(self, depth: int) -> int:
        token = self._tokens.token
        if self._tokens.accept("("):
            inner = self._union(depth + 1)
            if not self._tokens.accept(")"):
                raise self._unexpected("`)` or an operator")
            return inner
        if token.kind != "name":
            raise self._unexpected("an event, `epsilon`, `empty`, `~` or `(`")
        self._tokens.take()
        if token.text == "epsilon":
            return self.arena.epsilon
        if token.text == "empty":
            return self.arena.empty
        self._tokens.check_event(token)
        return self.arena.symbol(self._letters.setdefault(token.text, len(self._letters)))

    def _bounded(self, number: int) -> int:
        if self.arena[number].size > MAX_SYMBOLS:
            raise self._source.error(
                0, f"an expression of more than {MAX_SYMBOLS} symbols; write a smaller one"
            )
        return number

    def _unexpected(self, what: str) -> Exception:
        hints = {
            "?": "; write `(x | epsilon)` for `x?`",
            "||": "; union is `|`",
            "&&": "; intersection is `&`",
            "!": "; complement is `~`",
        }
        token = self._tokens.token
        if token.kind in hints:
            return self._source.error(
                token.offset, f"`{token.text}` has no meaning in ere{hints[token.kind]}"
            )
        return self._tokens.unexpected(what)
