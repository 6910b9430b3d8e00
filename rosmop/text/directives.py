"""Lines for C++'s preprocessor, which there is none of: they may stand where leaving them out changes nothing."""

import re

from rosmop.form.positions import Position
from rosmop.text.errors import SpecificationError

_PIECE = re.compile(
    r"""(?P<comment>//[^\n]*|/\*(?:[^*]|\*(?!/))*(?:\*/|\Z))
    |\#[ \t]*(?P<word>if|ifn?def|el(?:se|if)|endif|define|undef|include|pragma|error|warning|line)\b
        [ \t]*(?P<macro>\w+)?(?:\\\r?\n|[^\n])*
    |(?P<name>[A-Za-z_]\w*)
    |"(?:\\[^\n]|[^"\\\n])*"?|'(?:\\[^\n]|[^'\\\n])'|\d[\w.]*|[^\s\ufeff]""",
    re.VERBOSE,
)
_CONDITIONS = ("if", "ifdef", "ifndef")


def check_directives(text: str, file: str) -> None:
    """Refuse conditions around more than comments, and macros whose names are used. Raises `SpecificationError`."""
    macros: dict[str, int] = {}
    used: set[str] = set()
    conditions: list[tuple[str, int]] = []
    for piece in _PIECE.finditer(text):
        word, place = piece["word"], piece.start()
        if word in _CONDITIONS:
            conditions.append((word, place))
        elif word == "endif":
            del conditions[-1:]
        elif word == "define":
            macros.setdefault(piece["macro"] or "", place)
        elif not word and not piece["comment"]:
            if conditions:
                word, place = conditions[0]
                raise _refused(text, file, place, f"#{word}", "leave what you want there, without conditions")
            if piece["name"]:
                used.add(piece["name"])
    for macro, place in macros.items():
        if macro in used:
            told = f"write `const double {macro} = …;`, or a function, into the specification"
            raise _refused(text, file, place, f"#define {macro}", told)


def _refused(text: str, file: str, place: int, what: str, instead: str) -> SpecificationError:
    position = Position(file, 1, 1).within(text, place)
    return SpecificationError.at(position, f"`{what}`: there is no preprocessor; {instead}")
