"""Reads the text of an ``.rv`` file into a tree, or says where and why it cannot.

Bounds: a file has at most `MAX_CHARACTERS`, and nests at most `MAX_DEPTH` deep; time and memory are linear in
its length, and no later pass meets anything deeper.
"""

import re
from functools import lru_cache

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedInput, UnexpectedToken

from rosmop.form.positions import Position
from rosmop.text import tree
from rosmop.text.builder import Builder, check
from rosmop.text.complaints import FORBIDDEN, RESERVED, describe, misplaced
from rosmop.text.directives import check_directives
from rosmop.text.errors import SpecificationError
from rosmop.text.grammar import GRAMMAR

MAX_CHARACTERS = 128 * 1024
MAX_DEPTH = 100
"""Statements and operators inside each other."""

_NO_TEXT = re.compile("[\ud800-\udfff]")
"""Half a character: what a reader that goes on after bytes that are no UTF-8 puts in their place."""


class _ForbiddenWordError(Exception):
    def __init__(self, token: Token) -> None:
        super().__init__(str(token))
        self.token = token


def parse(text: str, file: str) -> tree.File:
    """Parse a file; `file` is its name in positions. Raises `SpecificationError`."""
    start = Position(file, 1, 1)
    if len(text) > MAX_CHARACTERS:
        raise SpecificationError.at(
            start, f"the file has more than {MAX_CHARACTERS // 1024} Ki characters; split it into several"
        )
    broken = _NO_TEXT.search(text)
    if broken is not None:
        raise SpecificationError.at(
            start.within(text, broken.start()), "these bytes are no UTF-8; save the file as UTF-8"
        )
    check_directives(text, file)
    parsed = _parse(text, file)
    _check_depth(parsed, file)
    builder = Builder(file, text)
    result: tree.File = builder.transform(parsed)
    check(builder)
    if not result.specifications:
        raise SpecificationError.at(
            start, "there is no specification in this file; write `name() { event … }`"
        )
    return result


def _parse(text: str, file: str) -> Tree[Token]:
    try:
        return _parser().parse(text)
    except _ForbiddenWordError as error:
        begin, message = misplaced(text, error.token.start_pos or 0, str(error.token))
        raise SpecificationError.at(start_of(file, text, begin), message) from None
    except UnexpectedInput as error:
        at_end = isinstance(error, UnexpectedToken) and error.token.type == "$END"
        offset = len(text) if at_end or error.pos_in_stream is None else error.pos_in_stream
        if text[offset - 1 : offset + 1] == "->":
            offset -= 1
        begin, message = describe(text, offset, _accepted(error))
        raise SpecificationError.at(start_of(file, text, begin), message) from None


def start_of(file: str, text: str, offset: int) -> Position:
    """The position of a character; for the end of the text, the place behind the last thing in it."""
    if offset >= len(text):
        offset = len(text.rstrip())
    return Position(file, 1, 1).within(text, offset)


def _accepted(error: UnexpectedInput) -> set[str]:
    interactive = getattr(error, "interactive_parser", None)
    if interactive is not None:
        return set(interactive.accepts())
    return set(getattr(error, "allowed", None) or ())


def _check_depth(parsed: Tree[Token], file: str) -> None:
    waiting: list[tuple[Tree[Token], int]] = [(parsed, 0)]
    while waiting:
        node, depth = waiting.pop()
        if depth > MAX_DEPTH:
            position = Position(file, node.meta.line, node.meta.column)
            raise SpecificationError.at(
                position,
                f"nested more than {MAX_DEPTH} deep; use variables for parts of it, or helper functions",
            )
        waiting += [(child, depth + 1) for child in node.children if isinstance(child, Tree)]


def _allow(token: Token) -> Token:
    if token in FORBIDDEN or token in RESERVED:
        raise _ForbiddenWordError(token)
    return token


@lru_cache(maxsize=1)
def _parser() -> Lark:
    """The parser, made at the first use: it is always the same and keeps no state between files."""
    return Lark(
        GRAMMAR,
        start="file",
        parser="lalr",
        propagate_positions=True,
        maybe_placeholders=True,
        lexer_callbacks={"NAME": _allow},
    )
