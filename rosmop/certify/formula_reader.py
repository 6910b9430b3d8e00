"""Parse a formula into nested tuples, without using code of the compilers.

A node is (operator, operand, …), ("event", name), ("true",) or ("false",). A property with an unknown formula is not
certified.
"""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal

Node = tuple[object, ...]

DEEPEST = 120

_TOKEN = re.compile(
    r"(?:\s++|//[^\n]*+|/\*.*?\*/)*+(?:([A-Za-z_]\w*|\d+(?:\.\d+)?|\.\d+)|(.))?", re.DOTALL | re.ASCII
)
_NUMBER = re.compile(r"[0-9]*\.?[0-9]+")


class UnsupportedFormulaError(Exception):
    """The formula has a part that the certifier does not know."""


class WorkLimitError(Exception):
    """A check takes more work than its limit."""


_NANOSECONDS = {"ns": 0, "us": 3, "ms": 6, "s": 9}
_SECONDS = {"m": 60, "min": 60, "h": 3600}


class WordReader:
    """The words and signs of a text, in order. Each of `signs` may have several characters."""

    def __init__(self, text: str, signs: Sequence[str]) -> None:
        self._signs = sorted(signs, key=len, reverse=True)
        self._text = text
        self._at = 0
        self.word = ""
        self.take()

    def take(self) -> str:
        before = self.word
        match = _TOKEN.match(self._text, self._at)
        if match is None:  # the pattern matches any text
            raise UnsupportedFormulaError(self._text[self._at : self._at + 10])
        name, start = match.group(1), match.end()
        if match.group(2) is not None:
            start = match.start(2)
            sign = next((sign for sign in self._signs if self._fits(sign, start)), None)
            if sign is None:
                raise UnsupportedFormulaError(f"the sign {self._text[start]}")
            name, self._at = sign, start + len(sign)
        else:
            name, self._at = name or "", match.end()
        self.word = name
        return before

    def _fits(self, sign: str, at: int) -> bool:
        end = at + len(sign)
        if not self._text.startswith(sign, at):
            return False
        return not (sign[-1].isalnum() and self._text[end : end + 1].replace("_", "a").isalnum())

    def accept(self, word: str) -> bool:
        if self.word != word:
            return False
        self.take()
        return True

    def expect(self, word: str) -> None:
        if not self.accept(word):
            raise UnsupportedFormulaError(f"{self.word!r} where {word!r} is expected")

    def duration(self) -> int:
        word = self.take()
        if _NUMBER.fullmatch(word) is None:
            raise UnsupportedFormulaError(f"{word!r} where a duration is expected")
        number = Decimal(word)
        if self.word in _NANOSECONDS:
            return int(number.scaleb(_NANOSECONDS[self.take()]))
        return int((number * (_SECONDS[self.take()] if self.word in _SECONDS else 1)).scaleb(9))

    def end(self) -> None:
        if self.word:
            raise UnsupportedFormulaError(f"{self.word!r} after the end")


_BOOLEAN: tuple[Mapping[str, str], ...] = (
    {"and": "and", "&&": "and", "/\\": "and"},
    {"xor": "xor", "++": "xor", "^": "xor"},
    {"or": "or", "||": "or", "\\/": "or"},
    {"=>": "implies", "->": "implies", "implies": "implies", "<=>": "iff", "<->": "iff"},
)
_NOT = {"!": "not", "not": "not"}
_FUTURE = {
    "U": "until", "~U": "release", "R": "release",
}  # fmt: skip
_BACK = {"(*)": "previously", "~(*)": "dual previously", "<*>": "once", "[*]": "historically"}
_SINCE = {"S": "since", "~S": "dual since"}
LTL = (
    {**_NOT, **_BACK, "o": "next", "~o": "next", "[]": "always", "<>": "eventually"},
    (*_BOOLEAN[:3], {**_BOOLEAN[3], **_FUTURE, **_SINCE}),
)
PTLTL = ({**_NOT, **_BACK}, (_SINCE, *_BOOLEAN))
MTL = (
    {**_NOT, **{word: word for word in ("previously", "once", "historically")}},
    ({"since": "since"}, *_BOOLEAN),
)

Grammar = tuple[Mapping[str, str], Sequence[Mapping[str, str]]]


def formula(text: str, events: Sequence[str], grammar: Grammar) -> Node:
    unary, levels = grammar
    signs = {"(", ")", "[", "]", ",", *unary, *(sign for level in levels for sign in level)}
    words = WordReader(text, [sign for sign in signs if not sign.isidentifier()])
    node = _join(words, events, grammar, len(levels) - 1, 0)
    words.end()
    return node


def _join(words: WordReader, events: Sequence[str], grammar: Grammar, level: int, depth: int) -> Node:
    if level < 0:
        return _operand(words, events, grammar, depth)
    node = _join(words, events, grammar, level - 1, depth)
    while words.word in grammar[1][level]:
        operator = grammar[1][level][words.take()]
        _unbounded(words, grammar)
        node = (operator, node, _join(words, events, grammar, level - 1, depth))
    return node


def _operand(words: WordReader, events: Sequence[str], grammar: Grammar, depth: int) -> Node:
    if depth > DEEPEST:
        raise UnsupportedFormulaError("it is nested too deeply")
    unary, levels = grammar
    if words.word in unary:
        operator = unary[words.take()]
        _unbounded(words, grammar)
        return (operator, _operand(words, events, grammar, depth + 1))
    if words.accept("("):
        node = _join(words, events, grammar, len(levels) - 1, depth + 1)
        words.expect(")")
        return node
    word = words.take()
    if word in ("true", "false"):
        return (word,)
    if word not in events:
        raise UnsupportedFormulaError(f"{word!r} is not an event")
    return ("event", word)


def _unbounded(words: WordReader, grammar: Grammar) -> None:
    if grammar is MTL and words.accept("["):
        if words.duration() != 0:
            raise UnsupportedFormulaError("a bound of time")
        for word in (",", "inf", "]"):
            words.expect(word)


def expression(text: str, events: Sequence[str]) -> Node:
    words = WordReader(text, "|&~*+^()")
    node = _union(words, events, 0)
    words.end()
    return node


def _union(words: WordReader, events: Sequence[str], depth: int) -> Node:
    node = _intersection(words, events, depth)
    while words.accept("|"):
        node = ("union", node, _intersection(words, events, depth))
    return node


def _intersection(words: WordReader, events: Sequence[str], depth: int) -> Node:
    node = _factors(words, events, depth)
    while words.accept("&"):
        node = ("intersection", node, _factors(words, events, depth))
    return node


def _factors(words: WordReader, events: Sequence[str], depth: int) -> Node:
    node = _factor(words, events, depth)
    while words.word in ("(", "~") or words.word[:1].isalpha() or words.word[:1] == "_":
        node = ("sequence", node, _factor(words, events, depth))
    return node


def _factor(words: WordReader, events: Sequence[str], depth: int) -> Node:
    if depth > DEEPEST:
        raise UnsupportedFormulaError("it is nested too deeply")
    if words.accept("~"):
        return ("not", _factor(words, events, depth + 1))
    if words.accept("("):
        node = _union(words, events, depth + 1)
        words.expect(")")
    else:
        word = words.take()
        if word in ("epsilon", "empty"):
            node = (word,)
        elif word in events:
            node = ("event", word)
        else:
            raise UnsupportedFormulaError(f"{word!r} is not an event")
    while words.word in ("*", "+", "^"):
        sign = words.take()
        if sign == "^":
            count = words.take()
            if not count.isdigit():
                raise UnsupportedFormulaError(f"{count!r} is not a power")
            node = ("power", node, int(count))
        else:
            node = ("star", node) if sign == "*" else ("sequence", node, ("star", node))
    return node
