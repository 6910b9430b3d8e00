"""Says in words why a text is not of the grammar: what was found, what was expected, what to write instead."""

import re
from collections.abc import Set

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
    "and": "write `&&`",
    "or": "write `||`",
    "not": "write `!`",
}
"""Words of C++ that are not part of the language, and what to write instead."""

RESERVED = frozenset(
    [
        "if",
        "else",
        "while",
        "do",
        "for",
        "switch",
        "case",
        "default",
        "break",
        "continue",
        "return",
        "const",
        "static",
        "auto",
        "void",
        "bool",
        "char",
        "short",
        "int",
        "long",
        "float",
        "double",
        "signed",
        "unsigned",
        "new",
        "delete",
        "static_cast",
        "DROP",
        "PUBLISH",
        "__RESET",
        "using",
    ]
)
"""Words of the language that are never names."""

_FOUND = re.compile(
    r'"(?:\\.|[^"\\\n])*"|[A-Za-z_]\w*|\d[\w.]*|->|::|<<=|>>=|[-+*/%&|^<>=!]=|\+\+|--|&&|\|\||<<|>>|.',
    re.DOTALL,
)
_CONTAINER = re.compile(
    r"(?:std\s*::\s*)?\b(map|unordered_map|set|list|deque|queue|pair|array|tuple|shared_ptr|function)\s*<[^;{}]*\Z"
)
_NEARLY_EVENT = re.compile(r"\b(\w+)\s+(\w+)\s*\([^()]*\)\s*\Z")
_TRIGGERS = frozenset({"/", "service", "every"})
_HINTS = {
    "->": "there are no pointers; write `.`",
    "&": "there are no addresses; pass the variable itself",
    "*": "there are no pointers but `char *`; use the value itself",
    "@": "a handler belongs to a property: `logic: formula @category { … }`",
    "[": "there are no lambda functions; declare a helper function",
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


def shown(text: str) -> str:
    """A piece of the file as it may stand in a message: short, and without control characters."""
    clean = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text)
    return f"`{clean if len(clean) <= 40 else clean[:37] + '…'}`"


def describe(text: str, offset: int, accepted: Set[str]) -> str:
    """The message for text that cannot follow at `offset`, where a token of `accepted` could."""
    if offset >= len(text):
        piece, found, hint = "", "the end of the file", ""
    else:
        match = _FOUND.match(text, offset)
        piece = match[0] if match else text[offset]
        found = shown(piece)
        hint = FORBIDDEN.get(piece, _HINTS.get(piece, ""))
    if text.startswith("/*", offset):
        return "this comment does not end; write `*/` behind it"
    if piece == "[" and text[:offset].rstrip().endswith("]") and "SEMICOLON" in accepted:
        hint = "there are no arrays of arrays; use a `std::vector` of vectors"
    container = _CONTAINER.search(text, max(0, offset - 100), offset + 1)
    if container is not None:
        hint = f"there is no `{container[1]}`; use a `std::vector`"
    nearly = _NEARLY_EVENT.search(text, max(0, offset - 200), offset)
    if nearly is not None and {"SEMICOLON", "LBRACE"} <= accepted and piece in _TRIGGERS:
        return f"found {shown(nearly[1])} where an event begins with `event`; write `event {nearly[2]}(…)`"
    expected = _expected(accepted)
    before = text[:offset].rstrip()
    if "AT" in accepted and before.endswith(":"):
        return f"found {found}, expected a formula; a property is `logic: formula @category {{ … }}`"
    if "AT" in accepted and not before.endswith("}"):
        return f"found {found} after the formula, expected a handler `@category {{ … }}`"
    if "'" in found and "QUOTE" not in accepted and "STRING" in accepted:
        hint = hint or "a character literal is one character; write a string in double quotes"
    return f"found {found}, expected {expected}" + (f"; {hint}" if hint else "")


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
