"""Describe an invalid value for users: what it must be, and the nearest known value."""

import difflib
import re
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_MAXIMUM_CANDIDATES = 500
_LONGEST_SHOWN = 100
_MUST_BE = {
    "array": "a list",
    "bool": "true or false",
    "byte": "a size, for example 500MB or 2GiB",
    "dataclass": "a section: put its keys on the lines below it, indented",
    "enum": "{expected}",
    "finite": "a number",
    "float": "a number",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "int": "a whole number",
    "ip": "a network, for example 192.168.1.0/24",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "list": "a list, for example [a, b]",
    "literal": "{expected}",
    "null": "null",
    "object": "an object",
    "path": "the path of a file or folder",
    "str": "a text",
    "string": "a string; put a number or true in quotes",
    "string_pattern_mismatch": "{pattern}",
    "string_too_long": "at most {max_length} characters",
    "string_too_short": "at least {min_length} characters",
    "too_long": "{max_length} at most in number",
    "too_short": "{min_length} at least in number",
}
"""The requirement on a value, by pydantic's error type, its first word, or msgspec's type name."""
_BOUNDS = {">=": "at least", "<=": "at most", ">": "more than", "<": "less than"}
_PARTS = {"str": "characters", "array": "entries", "object": "fields"}
_BODY: dict[str, Callable[..., str]] = {
    r"Expected `(.*)`, got `(.*)`": lambda wanted, got: f"must be {_typed(wanted)}, not {_typed(got)}",
    r"Expected `(.*)` of length ([<>]=) (\d+)": (
        lambda what, bound, many: f"must have {_BOUNDS[bound]} {many} {_PARTS.get(what, 'parts')}"
    ),
    r"Expected `.*` ([<>]=?) (\S+)": lambda bound, limit: (
        f"must be {_BOUNDS[bound]} {limit.removesuffix('.0')}"
    ),
    r"(?s)Expected `.*` matching regex '(.*?)(?:\(\?!.*)?'": lambda pattern: f"must be {shape_of(pattern)}",
    r"(?s)Object missing required field `(.*)`": lambda name: f"the field `{name}` must be given",
    r"(?s)Object contains unknown field `(.*)`": lambda name: f"there is no field `{name}`",
    r"Number out of range": lambda: "must be a smaller number",
}
"""Patterns of msgspec's messages, and the messages for users."""


_NAME = re.compile(
    r"\^\(?\[([\w.-]+)\](?:\(\?:)?\[([\w.+ -]+)\]\{0,(\d+)\}(\[[\w.-]+\])?(?:\)\?)?(?:\\+(\.\w+))?(?:\$|\\Z)"
)
_HEX = re.compile(r"\^\[0-9a-f\]\{(\d+)\}\$")
_YAML = {
    r"'\\t'": "indent with spaces, not tabs",
    "mapping values are not allowed": "put a string with `: ` in quotes, and indent the keys of a section equally",
    "<block end>": "indent the lines of a block equally",
    "but got '<stream end>'|node content": "close the bracket, or complete its content",
    "end of stream": "close the quote",
    "cannot start any token|undefined alias": "put the string in quotes",
}


def not_yaml(problem: object) -> str:
    said = " ".join(str(problem).split())
    return "; ".join(
        [f"is not YAML: {said}", *[do for what, do in _YAML.items() if re.search(what, said)][:1]]
    )


def nearest(word: str, candidates: Collection[str]) -> str | None:
    if len(candidates) > _MAXIMUM_CANDIDATES or len(word) > 100:
        return None
    folded = {candidate.casefold(): candidate for candidate in candidates}
    near = difflib.get_close_matches(word.casefold(), list(folded), n=1, cutoff=0.6)
    return folded[near[0]] if near else None


def meant(word: str, candidates: Collection[str]) -> str:
    found = nearest(word, candidates)
    return f"; did you mean {found}?" if found else ""


def must_be(error: "ErrorDetails") -> str:
    """Return the requirement on a value; `error` is one of pydantic's `errors()`."""
    kind, context = str(error["type"]), error.get("ctx") or {}
    wanted = _MUST_BE.get(kind) or _MUST_BE.get(kind.partition("_")[0]) or f"of another type ({kind})"
    shown = {name: _plain(value) for name, value in context.items()}
    if "pattern" in shown:
        shown["pattern"] = shape_of(str(shown["pattern"]))
    return wanted.format(**shown)


def refusal(error: "ErrorDetails") -> str:
    """Return the whole message; `error` is one of pydantic's `errors()`."""
    if error["type"] == "missing":
        return "must be given"
    if error["type"] == "value_error":  # raised by the appliance's own validator, with a complete message
        return str(error["ctx"]["error"])
    return f"must be {must_be(error)}, not {_cut(repr(error['input']))}"


def body_refusal(text: str, choices: Collection[str] = ()) -> str:
    """Return the message for msgspec's `ValidationError` without its path; `choices` are those of an enumeration."""
    no_choice = text.removeprefix("Invalid enum value ")
    if no_choice != text:
        return f"must be one of {', '.join(repr(str(choice)) for choice in choices)}, not {_cut(no_choice)}"
    for pattern, said in _BODY.items():
        if (match := re.fullmatch(pattern, text)) is not None:
            return said(*match.groups())
    return text


def refused_field(error: Exception, where: str = "", choices: Collection[str] = ()) -> tuple[str, str]:
    """Return the place of msgspec's `ValidationError` below `where`, and its message."""
    text, at, place = str(error).rpartition(" - at `")
    if not at:
        text, place = place, ""
    where += place.removeprefix("key` in `").removeprefix("$").removesuffix("`")
    return where, body_refusal(text, choices)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "…"


def shape_of(pattern: str) -> str:
    """Return what a string must be that matches a pattern, in words where they are known."""
    if (digits := _HEX.fullmatch(pattern)) is not None:
        return f"{digits[1]} hexadecimal digits (0-9, a-f)"
    match = _NAME.fullmatch(pattern)
    if match is None:
        return f"a string that matches {pattern}"
    first, rest, most, last, suffix = match.groups()
    begin = " or ".join(word.removesuffix("s") for word in _characters(first))
    ends = " and ends" if last else ""
    longest = int(most) + 1 + bool(last)
    name = f"a name of {', '.join(_characters(rest))}, at most {longest}, that begins{ends} with a {begin}"
    return f"{name}, followed by {suffix}" if suffix else name


def _characters(members: str) -> list[str]:
    words = ["letters" if "A-Z" in members else "small letters"] if "a-z" in members else []
    words += ["digits"] if "0-9" in members else []
    return [*words, *map(repr, re.sub("A-Z|a-z|0-9", "", members))]


def _typed(types: str) -> str:
    return " or ".join(_MUST_BE.get(one, one) for one in types.split(" | "))


def _plain(value: object) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value
