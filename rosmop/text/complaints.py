"""Explain a syntax error: the text found, the text expected, and what to write instead."""

import re
import unicodedata
from collections.abc import Set

from rosmop.text.foreign import foreign

FORBIDDEN = {
    "class": "types cannot be declared; use the message types and variables",
    "struct": "types cannot be declared; use a message type, or one variable for each member",
    "union": "types cannot be declared; use a message type, or one variable for each member",
    "enum": "enumerations cannot be declared; write `const int NAME = 1;` for each value",
    "typedef": "types cannot be declared; write the type itself",
    "template": "templates cannot be declared; write a function for each type",
    "typename": "templates cannot be declared; write the type itself",
    "operator": "operators cannot be declared; write a function",
    "goto": "there are no jumps; use a loop, `break` or `continue`",
    "try": "there are no exceptions; a fault stops the action and is recorded",
    "catch": "there are no exceptions; a fault stops the action and is recorded",
    "throw": "there are no exceptions; write `return;` to drop the message or `ROS_ERROR(…)` to report",
    "reinterpret_cast": "there are no pointers; write `static_cast<type>(…)` for numbers",
    "const_cast": "there are no pointers; declare the variable without `const`",
    "dynamic_cast": "there are no pointers or classes; write `static_cast<type>(…)` for numbers",
    "asm": "there is no machine code",
    "nullptr": "there are no pointers; use an empty string or a `bool`",
    "NULL": "there are no pointers; use an empty string or a `bool`",
    "extern": "a shared variable of another specification is visible by its name; leave this line out",
    "virtual": "types cannot be declared",
    "friend": "types cannot be declared",
    "sizeof": "sizes of types have no meaning here; write `.size()`",
    "decltype": "write the type itself, or `auto`",
    "wchar_t": "write `char` or `std::string`",
    "namespace": "there are no namespaces; leave it out",
    "public": "types cannot be declared; leave it out",
    "private": "types cannot be declared; leave it out",
    "protected": "types cannot be declared; leave it out",
    "this": "write the variable by its name",
    "register": "leave it out",
    "mutable": "leave it out",
    "explicit": "types cannot be declared; leave it out",
    "noexcept": "there are no exceptions; leave it out",
    "thread_local": "messages come one at a time; leave it out",
    "alignas": "leave it out",
    "xor": "write `!=`, or `^` for bits",
    "bitand": "write `&`",
    "bitor": "write `|`",
    "compl": "write `~`",
    "and": "write `&&`",
    "or": "write `||`",
    "not": "write `!`",
}

RESERVED = frozenset({
    "if", "else", "while", "do", "for", "switch", "case", "default", "break", "continue", "return", "const",
    "static", "auto", "void", "bool", "char", "short", "int", "long", "float", "double", "signed",
    "unsigned", "new", "delete", "static_cast", "DROP", "PUBLISH", "__RESET", "using",
})  # fmt: skip

_FOUND = re.compile(
    r'"(?:\\.|[^"\\\n])*"|[A-Za-z_]\w*|\d[\w.]*|->|::|<<=|>>=|[-+*/%&|^<>=!]=|\+\+|--|&&|\|\||<<|>>|.',
    re.DOTALL,
)
_HEAD = frozenset({"EVERY", "SERVICE_PART", "WHEN", "DURATION"})
_EVENT_FORM = "an event is `event name(int x) /topic package/Type '{field:x}' when (condition) { … }`"
_FORMS = tuple(
    (re.compile(behind), form)
    for behind, form in (
        (r"\bevent\s+\w+\s*\Z", _EVENT_FORM),
        (
            r"\bevent\s+\w+\s*\([^()]*\)[^;']*['\u2018\u2019\u00b4`]\{[^';]*\Z",
            "a pattern is `'{field:x, list[0]:y, field:5}'`; a condition follows it: `when (x > 3)`",
        ),
        (r"@\s*\w+\s*\Z", "a handler is `@category { … }`"),
        (r"(?:\A|[};])\s*order\s[^{};]*\Z", "an order is `order first < second;`"),
        (
            r"(?:\A|[};])\s*preset\s[^{};]*(?:\{[^{}]*)?\Z",
            "a preset is `preset name 1 as other on { topic = /topic package/Type; value = 5; }`, or `preset name 1;`",
        ),
        (
            r"(?:\A|[};])\s*role\s[^{};]*(?:\{[^{};]*)?\Z",
            "a role is `role Name(double x) { package/Type '{field:x}'; }`",
        ),
        (
            r"\bgiven\s*\{[^{}]*\Z",
            "a given is `double name = 0.22 m/s in 0..2;`, `bool name = true;` or `topic name = /topic;`",
        ),
        (
            r"\bsafe\s[^;{}]*(?:\{[^{}]*\}[^;{}]*)?\Z",
            "a safe message is `safe package/Type { field:5 } on /topic every 100ms;`",
        ),
        (
            r"\bwithhold\s[^;{}]*\Z",
            'a topic is withheld by `withhold /topic from "10.0.0.7", "10.8.0.0/16" while variable;`',
        ),
        (r"\binit\s*\Z", "write `init() { … }`"),
        (r"\b(?:if|while|switch|for|when)\s*\Z", "a condition is written in parentheses"),
    )
)
_PIECE = re.compile(
    r"""(?P<gap>\s+|//[^\n]*|/\*(?:[^*]|\*(?!/))*\*/)|"(?:\\.|[^"\\\n])*"|'\\?[^\n]'|[{}]|[^\s{}"'/]+|."""
)
_PLAIN = {"\u2212": "-", "\u2260": "!=", "\u2264": "<=", "\u2265": ">=", "\u00d7": "*", "\u00f7": "/", "\u2192": "->",
          "\u2227": "&&", "\u2228": "||", "\u00ac": "!", "\u2019": "'", "\u2018": "'", "\u201e": '"'}  # fmt: skip
_HINTS = {
    "&": "there are no addresses; pass the variable itself",
    "*": "there are no pointers except `char *`; use the value itself (of an iterator: `for (auto& x : v) { … }`)",
    "@": "a handler belongs to a property: `logic: formula @category { … }`",
    '"': "a string ends on the line it begins on",
}
_WORDS = {
    "NAME": "a name",
    "NUMBER": "a number",
    "STRING": "a string",
    "CHARACTER": "a character",
    "TOPIC": "a topic such as `/landshark/scan`",
    "MESSAGE_TYPE": "a message type such as `std_msgs/String`",
    "SERVICE_PART": "`request` or `response`",
    "DURATION": "a duration such as `100ms`",
    "QUOTE": "a quote `'`",
    "FORMULA": "a formula",
    "CATEGORY": "the name of a category",
    "AT": "a handler `@category { … }`",
    "BUILTIN": "a type",
    "SEMICOLON": "`;`",
    "COMMA": "`,`",
    "COLON": "`:`",
    "LBRACE": "`{`",
    "RBRACE": "`}`",
    "LPAR": "`(`",
    "RPAR": "`)`",
    "LSQB": "`[`",
    "RSQB": "`]`",
    "LESSTHAN": "`<`",
    "MORETHAN": "`>`",
    "WHEN": "`when (…)`",
    "EVENT": "`event`",
    "WHILE": "`while`",
    "DOUBLE_COLON": "`::`",
    "SERVICE": "`service`",
    "EVERY": "`every`",
    "ON": "`on`",
    "ORDER": "`order`",
    "GIVEN": "`given`",
    "GIVEN_VALUE": "a value such as `0.22 m/s in 0..2`",
    "GIVEN_KIND": "a list such as `corners`",
    "TOPIC_WORD": "`topic`",
    "ROW_TYPE": "a message type such as `std_msgs/String`",
    "SAFE": "`safe`",
    "WITHHOLD": "`withhold`",
    "FROM": "`from`",
    "STOP": "`STOP;`",
    "EQUAL": "`=`",
    "$END": "the end of the file",
}

_SITUATIONS: tuple[tuple[Set[str], str, str], ...] = (
    ({"RETURN"}, "RBRACE", "a statement"),
    ({"EVENT", "RBRACE"}, "", "a declaration, an `event`, a function, a property or `}`"),
    ({"FORMULA"}, "", "a formula"),
    ({"$END"}, "", "a specification `name() { … }` or the end of the file"),
    ({"NUMBER", "STRING", "NAME"}, "RPAR", "an expression"),
    ({"SEMICOLON", "COMMA", "EQUAL", "LBRACE"}, "", "`;` (or a value, `= …`)"),
)


def quote(text: str) -> str:
    clean = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text)
    return f"`{clean if len(clean) <= 40 else clean[:37] + '…'}`"


def describe(text: str, offset: int, accepted: Set[str]) -> tuple[int, str]:
    if offset >= len(text):
        return _at_end(text, accepted)
    if text.startswith("/*", offset):
        return offset, "this comment does not end; write `*/` after it"
    match = _FOUND.match(text, offset)
    piece = match[0] if match else text[offset]
    before = _code(text, offset)
    if "AT" in accepted and not before.endswith("}"):
        what = (
            ", expected a formula; a property is" if before.endswith(":") else " after the formula, expected"
        )
        form = "`logic: formula @category { … }`" if before.endswith(":") else "a handler `@category { … }`"
        return offset, f"found {quote(piece)}{what} {form}"
    advice = foreign(text, offset, len(_open_braces(text, offset)))
    if advice is not None:
        return advice[0], _refused(text, *advice)
    if "SEMICOLON" in accepted and "\n" in text[len(before) : offset] and before[-1:] not in "{};":
        line = text.count("\n", 0, offset) + 1
        return len(before), f"expected `;` after this, found {quote(piece)} in line {line}"
    hint = _hint(text[:offset], piece, accepted)
    return offset, f"found {quote(piece)}, expected {_expected(accepted)}" + (f"; {hint}" if hint else "")


def explain_misplaced(text: str, offset: int, word: str) -> tuple[int, str]:
    if word in FORBIDDEN:
        return offset, f"`{word}` is not part of the language; {FORBIDDEN[word]}"
    opened = _open_braces(text, offset)
    advice = foreign(text, offset, len(opened))
    if advice is not None:
        return advice[0], _refused(text, *advice)
    if not opened:
        return (
            offset,
            f"`{word}` is not allowed outside of a specification, `name() {{ … }}`; move this into one",
        )
    return offset, f"`{word}` is a keyword: it is not allowed here or as a name"


def _refused(text: str, begin: int, end: int, advice: str) -> str:
    return f"{quote(' '.join(text[begin:end].split()))} is not part of the language; {advice}"


def _hint(before: str, piece: str, accepted: Set[str]) -> str:
    if _HEAD & accepted or accepted in ({"MESSAGE_TYPE"}, {"QUOTE"}):
        return _EVENT_FORM
    for behind, form in _FORMS:
        if behind.search(before, max(0, len(before) - 200)):
            return form
    if not piece.isascii():
        plain = _PLAIN.get(piece) or unicodedata.normalize("NFKC", piece)
        name = f"this is U+{ord(piece[0]):04X}, {unicodedata.name(piece[0], 'a character without a name')}"
        return f"{name}; " + (f"write `{plain}`" if plain.isascii() else "names have only ASCII letters")
    if piece == "'" and "QUOTE" not in accepted and "STRING" in accepted:
        return "a character literal is one character; write a string in double quotes"
    return FORBIDDEN.get(piece, _HINTS.get(piece, ""))


def _open_braces(text: str, offset: int) -> list[int]:
    opened: list[int] = []
    for piece in _PIECE.finditer(text, 0, offset):
        if piece[0] == "{":
            opened.append(piece.start())
        elif piece[0] == "}":
            del opened[-1:]
    return opened


def _code(text: str, offset: int) -> str:
    ends = (piece.end() for piece in _PIECE.finditer(text, 0, offset) if not piece["gap"])
    return text[: max(ends, default=0)]


def _at_end(text: str, accepted: Set[str]) -> tuple[int, str]:
    opened = _open_braces(text, len(text))
    unclosed = ""
    if opened:
        line, column = text.count("\n", 0, opened[-1]) + 1, opened[-1] - text.rfind("\n", 0, opened[-1])
        unclosed = f"; the `{{` at {line}:{column} has no `}}`"
    return len(text), f"found the end of the file, expected {_expected(accepted)}{unclosed}"


def _expected(accepted: Set[str]) -> str:
    for needed, optional, words in _SITUATIONS:
        if needed <= accepted:
            return words + (f" or {_WORDS[optional]}" if optional in accepted else "")
    if "ASSIGN" in accepted or "PLUS" in accepted:
        closers = [word for word in ("SEMICOLON", "RPAR", "RSQB", "COMMA", "COLON") if word in accepted]
        return " or ".join([*(_WORDS[word] for word in closers), "an operator"])
    if {"BUILTIN", "NAME"} <= accepted:
        return "a type" + (" or `)`" if "RPAR" in accepted else "")
    words_left = sorted({_WORDS[word] for word in accepted if word in _WORDS}) or ["something else"]
    return " or ".join([", ".join(words_left[:-1]), words_left[-1]] if len(words_left) > 1 else words_left)
