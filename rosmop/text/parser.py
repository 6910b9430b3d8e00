"""Parse the text of an ``.rv`` file into a tree, in time and memory linear in its length."""

import re
from collections.abc import Mapping
from functools import lru_cache

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.text.builder import TreeBuilder, check
from rosmop.text.complaints import FORBIDDEN, RESERVED, describe, misplaced
from rosmop.text.grammar import GRAMMAR
from rosmop.text.typed import made
from rosmop.types.roles import ROLES

MAX_CHARACTERS = 128 * 1024
MAX_DEPTH = 100

_NO_TEXT = re.compile("[\ud800-\udfff]")
"""Surrogates, which replace bytes that are not UTF-8."""

# Lines of the C++ preprocessor are ignored where the meaning stays the same.
_PREPROCESSED = re.compile(
    r"""(?P<comment>//[^\n]*|/\*(?:[^*]|\*(?!/))*(?:\*/|\Z))
    |\#[ \t]*(?P<word>if|ifn?def|el(?:se|if)|endif|define|undef|include|pragma|error|warning|line)\b
        [ \t]*(?P<macro>\w+)?(?:\\\r?\n|[^\n])*
    |(?P<name>[A-Za-z_]\w*)
    |"(?:\\[^\n]|[^"\\\n])*"?|'(?:\\[^\n]|[^'\\\n])'|\d[\w.]*|[^\s\ufeff]""",
    re.VERBOSE,
)
_CONDITIONS = ("if", "ifdef", "ifndef")


class _ForbiddenWordError(Exception):
    def __init__(self, token: Token) -> None:
        super().__init__(str(token))
        self.token = token


def parse(text: str, file: str) -> tree.SpecificationFile:
    """Return the tree of a file; `file` is its name in positions. Raises `SpecificationError`."""
    start = Position(file, 1, 1)
    if len(text) > MAX_CHARACTERS:
        raise SpecificationError.at(
            start, f"the file has more than {MAX_CHARACTERS // 1024} Ki characters; split it into several"
        )
    broken = _NO_TEXT.search(text)
    if broken is not None:
        raise SpecificationError.at(
            start.within(text, broken.start()), "these bytes are not UTF-8; save the file as UTF-8"
        )
    _check_directives(text, file)
    result = made(_built(text, file), roles)
    if not result.specifications and not result.orders:
        raise SpecificationError.at(
            start, "there is no specification in this file; write `name() { event … }`"
        )
    return result


def _built(text: str, file: str) -> tree.TypedFile:
    parsed = _parse(text, file)
    _check_depth(parsed, file)
    builder = TreeBuilder(file, text)
    result: tree.TypedFile = builder.transform(parsed)
    check(builder)
    return result


@lru_cache(maxsize=1)
def roles() -> Mapping[str, tree.RoleDeclaration]:
    """Return the roles that every file has."""
    return {role.name: role for role in _built(ROLES, "the roles").roles}


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
        early = _ended_early(text, offset)
        if early is not None:
            advice = (
                "a comment ends at the first `*/`: here in `/*/`; write a space before its `/`, or use `//`"
            )
            raise SpecificationError.at(start_of(file, text, early), advice) from None
        begin, message = describe(text, offset, _accepted(error))
        raise SpecificationError.at(start_of(file, text, begin), message) from None


def _ended_early(text: str, offset: int) -> int | None:
    comments = [piece for piece in _PREPROCESSED.finditer(text, 0, offset) if piece["comment"]]
    last = comments[-1] if comments else None
    if last is None or not last[0].startswith("/*") or not last[0][2:].endswith("/*/"):
        return None
    return last.end() - 3 if text[last.end() : offset].count("\n") <= 1 else None


def start_of(file: str, text: str, offset: int) -> Position:
    if offset >= len(text):
        offset = len(text.rstrip())
    return Position(file, 1, 1).within(text, offset)


def _accepted(error: UnexpectedInput) -> set[str]:
    if isinstance(error, UnexpectedToken):
        return set(error.accepts)
    return set(error.allowed or ()) if isinstance(error, UnexpectedCharacters) else set()


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
    return Lark(
        GRAMMAR,
        start="file",
        parser="lalr",
        propagate_positions=True,
        maybe_placeholders=True,
        lexer_callbacks={"NAME": _allow},
    )


def _check_directives(text: str, file: str) -> None:
    macros: dict[str, int] = {}
    used: set[str] = set()
    conditions: list[tuple[str, int]] = []
    for piece in _PREPROCESSED.finditer(text):
        word, place = piece["word"], piece.start()
        if word in _CONDITIONS:
            conditions.append((word, place))
        elif word == "include" and (included := re.search(r'"([^"\n]*\.rv)"', piece[0])):
            instead = f"load {included[1]} with this file: its variables are seen here, but not its functions"
            raise _directive_error(text, file, place, f'#include "{included[1]}"', instead)
        elif word == "endif":
            del conditions[-1:]
        elif word == "define":
            macros.setdefault(piece["macro"] or "", place)
        elif not word and not piece["comment"]:
            if conditions:
                word, place = conditions[0]
                raise _directive_error(
                    text, file, place, f"#{word}", "keep the lines that you want, without conditions"
                )
            if piece["name"]:
                used.add(piece["name"])
    for macro, place in macros.items():
        if macro in used:
            advice = f"write `const double {macro} = …;`, or a function, into the specification"
            raise _directive_error(text, file, place, f"#define {macro}", advice)


def _directive_error(text: str, file: str, place: int, what: str, instead: str) -> SpecificationError:
    position = Position(file, 1, 1).within(text, place)
    return SpecificationError.at(position, f"`{what}`: there is no preprocessor; {instead}")
