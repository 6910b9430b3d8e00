"""Parse the text of `.msg` and `.srv` files into fields and constants.

Comments, constants and names of types follow genmsg, because the md5sum depends on them. The text may come
from an unknown host's connection header, and is never executed.
"""

import itertools
import re
from dataclasses import dataclass

from roswire.counted import counted
from roswire.errors import DefinitionError

PRIMITIVES = {
    "bool": ("?", 1),
    "int8": ("b", 1),
    "byte": ("b", 1),
    "uint8": ("B", 1),
    "char": ("B", 1),
    "int16": ("h", 2),
    "uint16": ("H", 2),
    "int32": ("i", 4),
    "uint32": ("I", 4),
    "int64": ("q", 8),
    "uint64": ("Q", 8),
    "float32": ("f", 4),
    "float64": ("d", 8),
    "time": ("II", 8),
    "duration": ("ii", 8),
}
"""The types of fixed size: their `struct` codes (little-endian, unpadded) and sizes in bytes."""

BUILTINS = frozenset({*PRIMITIVES, "string"})

MAX_FIELDS = 10_000

_INTEGERS = {
    name: (-(1 << (8 * size - 1)), (1 << (8 * size - 1)) - 1)
    if code.islower()
    else (0, (1 << (8 * size)) - 1)
    for name, (code, size) in PRIMITIVES.items()
    if len(code) == 1 and code in "bBhHiIqQ"
}
_CONSTANT_TYPES = frozenset({*_INTEGERS, "bool", "float32", "float64", "string"})
_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*+(?:/[A-Za-z][A-Za-z0-9_]*+)?)(\[([0-9]{0,10}+)\])?\Z")
_FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,254}+\Z")
_MAX_NUMBER_LENGTH = 400  # the maximum number of characters of a numeric constant
_SEPARATOR = re.compile(r"={40,}+[ \t\r]*+\Z")


@dataclass(frozen=True, slots=True)
class Constant:
    """A constant. The md5sum of its message uses `text`, the value as written."""

    type: str
    name: str
    value: bool | int | float | str
    text: str


@dataclass(frozen=True, slots=True)
class Field:
    """A field. `type` is the type of an element; `length` is None unless the field is an array of fixed length."""

    type: str
    name: str
    is_array: bool = False
    length: int | None = None

    @property
    def notation(self) -> str:
        if not self.is_array:
            return self.type
        return f"{self.type}[{'' if self.length is None else self.length}]"


@dataclass(frozen=True, slots=True)
class MessageDefinition:
    """A message type named `package/Type`, with its source `text`."""

    name: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...]
    text: str


@dataclass(frozen=True, slots=True)
class ServiceDefinition:
    """A service type. Its messages are named `package/TypeRequest` and `package/TypeResponse`."""

    name: str
    request: MessageDefinition
    response: MessageDefinition
    text: str


def parse_message(name: str, text: str, source: str, first_line: int = 1) -> MessageDefinition:
    """Parse a message type. Errors (`DefinitionError`) name `source`, and count lines from `first_line`."""
    fields: dict[str, Field] = {}
    constants: dict[str, Constant] = {}
    for number, line in enumerate(text.split("\n"), first_line):
        code = line.split("#", 1)[0].strip()
        if not code:
            continue
        if len(fields) + len(constants) >= MAX_FIELDS:
            raise DefinitionError(f"{name} has more than {MAX_FIELDS} fields", source, number)
        if "=" in code:
            constant = _constant(line, code, source, number)
            if constant.name in constants:
                raise DefinitionError(f"constant {constant.name} occurs twice", source, number)
            constants[constant.name] = constant
        else:
            field = _field(code, name.partition("/")[0], source, number)
            if field.name in fields:
                raise DefinitionError(f"field {field.name} occurs twice", source, number)
            fields[field.name] = field
    return MessageDefinition(name, tuple(fields.values()), tuple(constants.values()), text)


def parse_service(name: str, text: str, source: str) -> ServiceDefinition:
    lines = text.split("\n")
    breaks = [index for index, line in enumerate(lines) if line.startswith("---")]
    if len(breaks) != 1:
        raise DefinitionError(
            f"{counted(len(breaks), 'line')} '---'; write one between request and response", source
        )
    middle = breaks[0]
    request = parse_message(f"{name}Request", "\n".join(lines[:middle]), source)
    response = parse_message(f"{name}Response", "\n".join(lines[middle + 1 :]), source, middle + 2)
    return ServiceDefinition(name, request, response, text)


def split_full_text(name: str, text: str) -> list[tuple[str, str, int]]:
    """Return (type, text, number of its first line) for `name`, then for each nested type.

    A line of `=` and a line `MSG: package/Type` precede each nested type. Raise `DefinitionError` for other text
    there.
    """
    lines = text.split("\n")
    starts = [index for index, line in enumerate(lines) if _SEPARATOR.match(line)]
    sections = [(name, "\n".join(lines[: starts[0]] if starts else lines), 1)]
    for start, end in itertools.pairwise([*starts, len(lines)]):
        title = lines[start + 1].strip() if start + 1 < end else ""
        if not title.startswith("MSG:"):
            raise DefinitionError(
                f"{title[:80]!a} after a line of '='; expected 'MSG: package/Type'", name, start + 2
            )
        sections.append((title[4:].strip(), "\n".join(lines[start + 2 : end]), start + 3))
    return sections


def _field(code: str, package: str, source: str, line: int) -> Field:
    words = code.split()
    if len(words) != 2:
        raise DefinitionError(f"{code[:80]!a} is not a field; write 'type name'", source, line)
    notation, name = words
    match = _TYPE.match(notation)
    if match is None:
        raise DefinitionError(f"{notation[:80]!a} is not a type; write type, type[] or type[3]", source, line)
    if _FIELD_NAME.match(name) is None:
        raise DefinitionError(
            f"{name[:80]!a} is not a field name; it has a letter and then up to 254 letters, digits and '_'",
            source,
            line,
        )
    type_name, array, length = match.groups()
    if type_name == "Header":
        type_name = "std_msgs/Header"
    elif "/" not in type_name and type_name not in BUILTINS:
        type_name = f"{package}/{type_name}"
    return Field(type_name, name, array is not None, int(length) if length else None)


def _constant(line: str, code: str, source: str, number: int) -> Constant:
    type_name = code.split(maxsplit=1)[0]
    if type_name not in _CONSTANT_TYPES:
        raise DefinitionError(f"{type_name[:80]!a} is not a type of a constant", source, number)
    # The value of a string extends to the end of the line, including '#'.
    rest = (line if type_name == "string" else code).lstrip()[len(type_name) :]
    name, _, text = rest.partition("=")
    name, text = name.strip(), text.strip()
    if _FIELD_NAME.match(name) is None:
        raise DefinitionError(f"{name[:80]!a} is not a name of a constant", source, number)
    try:
        value = _value(type_name, text)
    except ValueError:
        raise DefinitionError(f"{text[:80]!a} is not of type {type_name}", source, number) from None
    return Constant(type_name, name, value, text)


def _value(type_name: str, text: str) -> bool | int | float | str:
    if type_name == "string":
        return text
    if len(text) > _MAX_NUMBER_LENGTH:
        raise ValueError(text)
    if type_name == "bool":
        return text == "True" if text in ("True", "False") else bool(int(text))
    if type_name not in _INTEGERS:
        return float(text)
    value = int(text)
    least, most = _INTEGERS[type_name]
    if not least <= value <= most:
        raise ValueError(text)
    return value
