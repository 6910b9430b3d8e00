"""Message types as the language sees them: fields in order, their types, and constants.

The definitions are those of `roswire`. A name that does not exist is refused with the nearest that does.
"""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from types import MappingProxyType

from rosmop.types import value_types
from rosmop.types.value_types import Type
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import Constant, Field, MessageDefinition

_COMPARED = 600  # names that a wrong one is compared with

PRIMITIVES: Mapping[str, Type] = MappingProxyType(
    {
        "bool": value_types.BOOL,
        "int8": value_types.INT8,
        "byte": value_types.INT8,
        "uint8": value_types.UINT8,
        "char": value_types.UINT8,
        "int16": value_types.INT16,
        "uint16": value_types.UINT16,
        "int32": value_types.INT,
        "uint32": value_types.UINT,
        "int64": value_types.LONG,
        "uint64": value_types.ULONG,
        "float32": value_types.FLOAT,
        "float64": value_types.DOUBLE,
        "string": value_types.STRING,
        "time": value_types.TIME,
        "duration": value_types.DURATION,
    }
)


@dataclass(frozen=True)
class Slot:
    """A field of a message: its place in the list that holds the message, its type, its definition."""

    index: int
    name: str
    type: Type
    field: Field


class UnknownNameError(Exception):
    """No such type or field; the text says so and what is near."""


class Messages:
    """The message types of a set of definitions."""

    def __init__(self, definitions: Definitions) -> None:
        self.definitions = definitions
        self._slots: dict[str, dict[str, Slot]] = {}

    def definition(self, name: str) -> MessageDefinition:
        """The definition of a message type, complete and usable; raises `UnknownNameError`."""
        try:
            self.definitions.layout(name)
            return self.definitions.message(name)
        except DefinitionError as error:
            if name in self.definitions.message_types:
                raise UnknownNameError(f"the definition of {name} cannot be used: {error}") from None
            raise UnknownNameError(
                f"there is no message type {shown(name)}{nearest(name, self.definitions.message_types)}; "
                "ROS's own are known, others need a .msg file (--msg DIR, or msg/ beside the file)"
            ) from None

    def slots(self, name: str) -> dict[str, Slot]:
        """The fields of a message type by name, in order."""
        if name not in self._slots:
            fields = self.definition(name).fields
            self._slots[name] = {
                field.name: Slot(index, field.name, field_type(field), field)
                for index, field in enumerate(fields)
            }
        return self._slots[name]

    def slot(self, name: str, field: str) -> Slot:
        """One field; raises `UnknownNameError` with the nearest."""
        slots = self.slots(name)
        if field not in slots:
            paths = self._paths_to(name, field)
            if paths:
                raise UnknownNameError(f"{name} has no field {shown(field)}; did you mean `{paths[0]}`?")
            raise UnknownNameError(f"{name} has no field {shown(field)}{nearest(field, slots)}")
        return slots[field]

    def constant(self, name: str, constant: str) -> Constant:
        """A constant of a message type; raises `UnknownNameError`."""
        constants = {known.name: known for known in self.definition(name).constants}
        if constant not in constants:
            raise UnknownNameError(f"{name} has no constant {shown(constant)}{nearest(constant, constants)}")
        return constants[constant]

    def _paths_to(self, name: str, field: str) -> list[str]:
        """Paths of at most three steps that end in a field of this name."""
        level = [("", name)]
        for _ in range(3):
            found = []
            below = []
            for prefix, record in level[:200]:
                for slot in self.slots(record).values():
                    if slot.name == field and prefix:
                        found.append(f"{prefix}{slot.name}")
                    if isinstance(slot.type, value_types.Record):
                        below.append((f"{prefix}{slot.name}.", slot.type.name))
            if found:
                return found
            level = below
        return []


def field_type(field: Field) -> Type:
    """The type of a field's value."""
    element = PRIMITIVES.get(field.type) or value_types.Record(field.type)
    return value_types.Vector(element, field.length) if field.is_array else element


def nearest(name: str, known: Iterable[str]) -> str:
    """What else could have been meant, as the tail of a message; of very many names, among the first."""
    known = list(islice(known, _COMPARED))  # a file can have thousands of names, and of mistakes
    near = difflib.get_close_matches(name[:100], known, 1, 0.65)
    if near:
        return f"; did you mean `{near[0]}`?"
    if 0 < len(known) <= 12:
        return "; there are: " + ", ".join(known)
    return ""


def shown(name: str) -> str:
    """A name as it may stand in a message."""
    return f"`{name if len(name) <= 60 else name[:57] + '…'}`"
