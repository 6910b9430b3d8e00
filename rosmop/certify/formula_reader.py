"""Reads a formula once more: text to nested tuples, without a word of what the compilers read.

A node is (operator, operand, …); ("event", name), ("true",), ("false",). What cannot be read raises `UnreadError`: the
property is then not certified, whatever the compiler made of it.
"""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal

Node = tuple[object, ...]
"""An operator, and its operands."""

DEEPEST = 120

_TOKEN = re.compile(
    r"(?:\s+|//[^\n]*|/\*.*?\*/)*(?:([A-Za-z_]\w*|\d+(?:\.\d+)?|\.\d+)|(.))?", re.DOTALL | re.ASCII
)


class UnreadError(Exception):
    """The formula has something that the certifier does not read."""


class TooMuchError(Exception):
    """What was to be followed is more than may be."""


_NANOSECONDS = {"ns": 0, "us": 3, "ms": 6, "s": 9}
_SECONDS = {"m": 60, "min": 60, "h": 3600}


class Words:
    """The words and signs of a text, one after the other; `signs` may be of several characters."""

    def __init__(self, text: str, signs: Sequence[str]) -> None:
        self._signs = sorted(signs, key=len, reverse=True)
        self._text = text
        self._at = 0
        self.word = ""
        self.take()

    def take(self) -> str:
        """The word that is next, and go on to the one behind it; empty at the end."""
        before = self.word
        match = _TOKEN.match(self._text, self._at)
        if match is None:  # it matches everything
            raise UnreadError(self._text[self._at : self._at + 10])
        name, start = match.group(1), match.end()
        if match.group(2) is not None:
            start = match.start(2)
            sign = next((sign for sign in self._signs if self._fits(sign, start)), None)
            if sign is None:
                raise UnreadError(f"the sign {self._text[start]}")
            name, self._at = sign, start + len(sign)
        else:
            name, self._at = name or "", match.end()
        self.word = name
        return before

    def _fits(self, sign: str, at: int) -> bool:
        """Whether the sign stands here; one that ends with a letter ends where the word ends."""
        end = at + len(sign)
        if not self._text.startswith(sign, at):
            return False
        return not (sign[-1].isalnum() and self._text[end : end + 1].replace("_", "a").isalnum())

    def accept(self, word: str) -> bool:
        """Take this word if it is next."""
        if self.word != word:
            return False
        self.take()
        return True

    def expect(self, word: str) -> None:
        """Take this word; raises `UnreadError` where another one stands."""
        if not self.accept(word):
            raise UnreadError(f"{self.word!r} where {word!r} belongs")

    def duration(self) -> int:
        """Take a number and its unit (seconds where there is none): nanoseconds."""
        number = Decimal(self.take())
        if self.word in _NANOSECONDS:
            return int(number.scaleb(_NANOSECONDS[self.take()]))
        return int((number * (_SECONDS[self.take()] if self.word in _SECONDS else 1)).scaleb(9))

    def end(self) -> None:
        """Raise `UnreadError` where something is left."""
        if self.word:
            raise UnreadError(f"{self.word!r} behind the end")


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
"""The operators of a logic: those before one operand, and those between two, from the tightest to the loosest."""

Grammar = tuple[Mapping[str, str], Sequence[Mapping[str, str]]]


def formula(text: str, events: Sequence[str], grammar: Grammar) -> Node:
    """A formula of temporal logic. Raises `UnreadError`."""
    unary, levels = grammar
    signs = {"(", ")", "[", "]", ",", *unary, *(sign for level in levels for sign in level)}
    words = Words(text, [sign for sign in signs if not sign.isidentifier()])
    node = _joined(words, events, grammar, len(levels) - 1, 0)
    words.end()
    return node


def _joined(words: Words, events: Sequence[str], grammar: Grammar, level: int, depth: int) -> Node:
    if level < 0:
        return _operand(words, events, grammar, depth)
    node = _joined(words, events, grammar, level - 1, depth)
    while words.word in grammar[1][level]:
        operator = grammar[1][level][words.take()]
        _unbounded(words, grammar)
        node = (operator, node, _joined(words, events, grammar, level - 1, depth))
    return node


def _operand(words: Words, events: Sequence[str], grammar: Grammar, depth: int) -> Node:
    if depth > DEEPEST:
        raise UnreadError("it is nested too deeply")
    unary, levels = grammar
    if words.word in unary:
        operator = unary[words.take()]
        _unbounded(words, grammar)
        return (operator, _operand(words, events, grammar, depth + 1))
    if words.accept("("):
        node = _joined(words, events, grammar, len(levels) - 1, depth + 1)
        words.expect(")")
        return node
    word = words.take()
    if word in ("true", "false"):
        return (word,)
    if word not in events:
        raise UnreadError(f"{word!r} is no event")
    return ("event", word)


def _unbounded(words: Words, grammar: Grammar) -> None:
    """Take the bounds of mtl that bound nothing."""
    if grammar is MTL and words.accept("["):
        if words.duration() != 0:
            raise UnreadError("a bound of time")
        for word in (",", "inf", "]"):
            words.expect(word)


def expression(text: str, events: Sequence[str]) -> Node:
    """An extended regular expression: union, intersection, sequence, not, star, power. Raises `UnreadError`."""
    words = Words(text, "|&~*+^()")
    node = _union(words, events, 0)
    words.end()
    return node


def _union(words: Words, events: Sequence[str], depth: int) -> Node:
    node = _intersection(words, events, depth)
    while words.accept("|"):
        node = ("union", node, _intersection(words, events, depth))
    return node


def _intersection(words: Words, events: Sequence[str], depth: int) -> Node:
    node = _factors(words, events, depth)
    while words.accept("&"):
        node = ("intersection", node, _factors(words, events, depth))
    return node


def _factors(words: Words, events: Sequence[str], depth: int) -> Node:
    node = _factor(words, events, depth)
    while words.word in ("(", "~") or words.word[:1].isalpha() or words.word[:1] == "_":
        node = ("sequence", node, _factor(words, events, depth))
    return node


def _factor(words: Words, events: Sequence[str], depth: int) -> Node:
    if depth > DEEPEST:
        raise UnreadError("it is nested too deeply")
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
            raise UnreadError(f"{word!r} is no event")
    while words.word in ("*", "+", "^"):
        sign = words.take()
        if sign == "^":
            count = words.take()
            if not count.isdigit():
                raise UnreadError(f"{count!r} is no power")
            node = ("power", node, int(count))
        else:
            node = ("star", node) if sign == "*" else ("sequence", node, ("star", node))
    return node
