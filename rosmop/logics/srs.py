"""``srs``: string rewriting systems, as MOP's SRS plugin reads them, bounded in length and in work for one event."""

from collections.abc import Sequence
from dataclasses import dataclass

from rosmop.logics.interface import (
    Categories,
    CompiledProperty,
    CostlyRun,
    Run,
    RunFaultError,
    Source,
    UntimedRun,
)
from rosmop.logics.lexer import FormulaToken, TokenReader

CATEGORIES: Categories = ("fail", "succeed")
MAX_RULES = 1_000
MAX_STRING = 100_000
MAX_WORK = 50_000
"""The most rules tried for one event. Sixteen compared symbols, and 64 moved ones, count as one more."""


@dataclass(frozen=True)
class RewriteRule:
    """A rule ``left -> right`` or ``left -> verdict``. ``begins`` and ``ends`` bind it to the string's ends."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    begins: bool
    ends: bool
    verdict: str = ""


class RewritingProperty(CompiledProperty):
    """A property for a rewriting system; symbols are numbers, events first."""

    def __init__(self, source: Source, rules: Sequence[RewriteRule]) -> None:
        super().__init__(source, CATEGORIES)
        self.rules = tuple(rules)
        self.longest = max(len(rule.left) for rule in rules)
        self.by_first: dict[int, tuple[RewriteRule, ...]] = {}
        for rule in rules:
            self.by_first[rule.left[0]] = (*self.by_first.get(rule.left[0], ()), rule)

    def start(self, _time_ns: int) -> Run:
        return RewritingRun(self)

    def categories_after(self, _event: int) -> frozenset[str]:
        return frozenset(rule.verdict for rule in self.rules if rule.verdict)


class RewritingRun(UntimedRun, CostlyRun):
    """A run: its string, or its final verdict. Between two events no rule applies."""

    __slots__ = ("_property", "string", "verdict", "work")

    def __init__(self, compiled: RewritingProperty) -> None:
        self._property = compiled
        self.string: list[int] = []
        self.verdict: Categories = ()
        self.work = 0

    def step(self, event: int, _time_ns: int) -> Categories:
        self.work = 0
        if not self.verdict:
            self.string, self.verdict = self._rewrite([*self.string, event])
        return self.verdict

    def save(self) -> tuple[list[int], Categories]:
        return self.string, self.verdict

    def restore(self, saved: tuple[list[int], Categories]) -> None:
        self.string, self.verdict = saved

    def _rewrite(self, string: list[int]) -> tuple[list[int], Categories]:
        """Return the rewritten string and its verdict. Invariant: no rule matches before `place`."""
        longest = self._property.longest
        place = max(0, len(string) - longest)
        while place < len(string):
            if len(string) > MAX_STRING:
                raise RunFaultError(f"the string has more than {MAX_STRING} symbols")
            rule, spent = _matching(self._property.by_first.get(string[place], ()), string, place)
            self.work += spent
            if rule is None:
                place += 1
            elif rule.verdict:
                return [], (rule.verdict,)
            else:
                end = place + len(rule.left)
                self.work += (len(string) - place) // 64
                string[place:end] = rule.right
                place = max(0, min(place - longest + 1, len(string) - longest))
            if self.work > MAX_WORK:
                raise RunFaultError(f"rewriting takes more than {MAX_WORK} steps for one event")
        return string, ()


def _matching(rules: Sequence[RewriteRule], string: list[int], place: int) -> tuple[RewriteRule | None, int]:
    work = 1
    for rule in rules:
        end = place + len(rule.left)
        work += 1
        if end <= len(string) and not (rule.begins and place) and not (rule.ends and end != len(string)):
            work += len(rule.left) // 16
            if tuple(string[place:end]) == rule.left:
                return rule, work
    return None, work


def compile_srs(source: Source) -> RewritingProperty:
    reader = TokenReader(source, ("->", "^", "$", ".", "#"))
    numbers = {name: number for number, name in enumerate(source.events)}
    rules = [_read_rule(reader, numbers)]
    while reader.token.kind != "end":
        if len(rules) >= MAX_RULES:
            raise source.error(reader.token.offset, f"more than {MAX_RULES} rules")
        rules.append(_read_rule(reader, numbers))
    made = {number for rule in rules for number in rule.right} | set(range(len(source.events)))
    names = {number: name for name, number in numbers.items()}
    for rule in rules:
        for number in rule.left:
            if number not in made:
                raise source.error(
                    0,
                    f"`{names[number]}` is neither an event nor on the right side of a rule: no string contains it",
                )
    reader.finish()
    return RewritingProperty(source, rules)


def _read_rule(reader: TokenReader, numbers: dict[str, int]) -> RewriteRule:
    begins = reader.accept("^")
    left = _read_symbols(reader, numbers)
    if not left:
        raise reader.unexpected("an event or a symbol: a rule rewrites at least one")
    ends = reader.accept("$")
    reader.expect("->", "`->` and the replacement")
    verdict = ""
    right: tuple[int, ...] = ()
    if reader.accept("#"):
        word = reader.expect("name", "`#epsilon`, `#fail` or `#succeed`")
        if word.text in CATEGORIES:
            verdict = word.text
        elif word.text != "epsilon":
            raise reader.source.error(
                word.offset, f"`#{word.text}` has no meaning in srs; write #epsilon, #fail or #succeed"
            )
    else:
        right = _read_symbols(reader, numbers)
        if not right:
            raise reader.unexpected("symbols, `#epsilon`, `#fail` or `#succeed`")
    reader.expect(".", "`.` at the end of the rule")
    return RewriteRule(left, right, begins, ends, verdict)


def _read_symbols(reader: TokenReader, numbers: dict[str, int]) -> tuple[int, ...]:
    tokens: list[FormulaToken] = []
    while reader.token.kind == "name":
        tokens.append(reader.take())
    return tuple(numbers.setdefault(token.text, len(numbers)) for token in tokens)
