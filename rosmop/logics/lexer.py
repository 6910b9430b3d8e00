"""Split a formula into tokens. Each logic has its signs; names, numbers, white space and C comments are common."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction

from rosmop.form.findings import Diagnostic
from rosmop.logics.interface import FormulaError, Source

MAX_CHARACTERS = 100_000
MAX_DURATION_NS = 10**18
"""About 31 years; longer bounds are rejected as mistakes."""
MAX_NUMBER_DIGITS = 30

UNITS_NS = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": 10**9,
    "m": 60 * 10**9,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
}


@dataclass(frozen=True)
class FormulaToken:
    """A token; its kind is the sign, ``name``, ``number`` or ``end``."""

    kind: str
    text: str
    offset: int


def tokenize(source: Source, signs: Sequence[str]) -> list[FormulaToken]:
    if len(source.text) > MAX_CHARACTERS:
        raise source.error(
            0, f"a formula of more than {MAX_CHARACTERS} characters; split it into several properties"
        )
    longest_first = [_sign_pattern(sign) for sign in sorted(signs, key=len, reverse=True)]
    lettered = "|".join(sign for sign in longest_first if sign[0].isalpha()) or "(?!)"
    alternatives = "|".join(longest_first) or "(?!)"
    pattern = re.compile(
        r"(?P<space>\s+|//[^\n]*|/\*.*?\*/)"
        r"|(?P<number>\d+(?:\.\d+)?|\.\d+)"
        f"|(?P<lettered>{lettered})"
        r"|(?P<name>[A-Za-z_][A-Za-z_0-9]*)"
        f"|(?P<sign>{alternatives})",
        re.DOTALL | re.ASCII,
    )
    tokens = []
    offset = 0
    while offset < len(source.text):
        match = pattern.match(source.text, offset)
        if match is None:
            raise source.error(offset, f"{_shown(source.text[offset])} has no meaning in {source.logic}")
        kind = "sign" if match.lastgroup == "lettered" else match.lastgroup or ""
        if kind != "space":
            text = match.group()
            tokens.append(FormulaToken(text if kind == "sign" else kind, text, offset))
        offset = match.end()
    tokens.append(FormulaToken("end", "", len(source.text)))
    return tokens


def _sign_pattern(sign: str) -> str:
    return re.escape(sign) + (r"(?![A-Za-z_0-9])" if sign[-1].isalnum() else "")


def _shown(character: str) -> str:
    return f"`{character}`" if character.isprintable() else f"the character U+{ord(character):04X}"


def describe(token: FormulaToken) -> str:
    if token.kind == "end":
        return "the end of the formula"
    shown = token.text if len(token.text) <= 40 else token.text[:37] + "…"
    return f"`{shown}`"


def suggestion(name: str, known: Sequence[str]) -> str:
    near = get_close_matches(name[:100], known, n=1)
    if near:
        return f"; did you mean `{near[0]}`?"
    if not known:
        return ""
    shown = ", ".join(known[:8]) + (", …" if len(known) > 8 else "")
    return f"; known: {shown}"


class TokenReader:
    """Walks over tokens, and collects errors that do not stop the reading."""

    def __init__(self, source: Source, signs: Sequence[str]) -> None:
        self.source = source
        self._tokens = tokenize(source, signs)
        self._next = 0
        self.findings: list[Diagnostic] = []

    @property
    def token(self) -> FormulaToken:
        return self._tokens[self._next]

    def ahead(self, count: int) -> FormulaToken:
        return self._tokens[min(self._next + count, len(self._tokens) - 1)]

    def take(self) -> FormulaToken:
        token = self._tokens[self._next]
        if token.kind != "end":
            self._next += 1
        return token

    def accept(self, kind: str) -> bool:
        if self.token.kind == kind:
            self._next += 1
            return True
        return False

    def expect(self, kind: str, what: str) -> FormulaToken:
        """Take a token of this kind. The error says that ``what`` was expected."""
        if self.token.kind != kind:
            raise self.unexpected(what)
        return self.take()

    def unexpected(self, what: str) -> FormulaError:
        return self.source.error(self.token.offset, f"expected {what}, found {describe(self.token)}")

    def note(self, token: FormulaToken, text: str) -> None:
        if len(self.findings) < 20:
            self.findings.append(self.source.finding(token.offset, text))

    def finish(self) -> None:
        if self.findings:
            raise FormulaError(sorted(self.findings, key=lambda finding: finding.position))

    def check_event(self, token: FormulaToken) -> None:
        if token.text not in self.source.events:
            hint = suggestion(token.text, self.source.events)
            self.note(token, f"`{token.text}` is not an event of this specification{hint}")

    def duration(self, what: str) -> int:
        """Return the nanoseconds of a duration such as ``100ms``, ``0.5 s`` or ``2`` (seconds)."""
        number = self.expect("number", f"{what} such as `100ms`, `0.5s` or `2m`")
        if len(number.text) > MAX_NUMBER_DIGITS:
            raise self.source.error(
                number.offset, f"a number of more than {MAX_NUMBER_DIGITS} digits is not a duration"
            )
        unit = 10**9
        if self.token.kind == "name" and (self.token.text in UNITS_NS or self._is_glued(number)):
            if self.token.text not in UNITS_NS:
                raise self.source.error(
                    self.token.offset,
                    f"`{self.token.text}` is not a unit of time; write one of {', '.join(UNITS_NS)}",
                )
            unit = UNITS_NS[self.take().text]
        nanoseconds = Fraction(number.text if number.text[0] != "." else "0" + number.text) * unit
        if nanoseconds.denominator != 1:
            raise self.source.error(number.offset, "a duration finer than a nanosecond; round it")
        if nanoseconds > MAX_DURATION_NS:
            raise self.source.error(number.offset, "a duration of more than 31 years; is the unit correct?")
        return int(nanoseconds)

    def _is_glued(self, number: FormulaToken) -> bool:
        return self.token.offset == number.offset + len(number.text)
