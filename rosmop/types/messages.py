"""Look up message types, with their fields and constants."""

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

_COMPARED = 600  # the maximum number of names to compare with an unknown name

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
class FieldSlot:
    """A field of a message type, and its `index` in the list of a message's values."""

    index: int
    name: str
    type: Type
    field: Field


class UnknownNameError(Exception):
    """An unknown name; the text suggests a similar name."""


class MessageTypes:
    """Looks up the message types of a set of definitions. Unknown and unusable names raise `UnknownNameError`."""

    def __init__(self, definitions: Definitions) -> None:
        self.definitions = definitions
        self._slots: dict[str, dict[str, FieldSlot]] = {}

    def definition(self, name: str) -> MessageDefinition:
        try:
            self.definitions.layout(name)
            return self.definitions.message(name)
        except DefinitionError as error:
            if name in self.definitions.message_types:
                raise UnknownNameError(f"the definition of {name} cannot be used: {error}") from None
            raise UnknownNameError(
                f"unknown message type {quote(name)}{nearest(name, self.definitions.message_types)}; "
                "ROS's own are known, others need a .msg file (--msg DIR, or msg/ beside the file)"
            ) from None

    def slots(self, name: str) -> dict[str, FieldSlot]:
        if name not in self._slots:
            fields = self.definition(name).fields
            self._slots[name] = {
                field.name: FieldSlot(index, field.name, field_type(field), field)
                for index, field in enumerate(fields)
            }
        return self._slots[name]

    def slot(self, name: str, field: str) -> FieldSlot:
        slots = self.slots(name)
        if field not in slots:
            paths = self._paths_to(name, field)
            if paths:
                raise UnknownNameError(f"{name} has no field {quote(field)}; did you mean `{paths[0]}`?")
            raise UnknownNameError(f"{name} has no field {quote(field)}{nearest(field, slots)}")
        return slots[field]

    def constant(self, name: str, constant: str) -> Constant:
        constants = {known.name: known for known in self.definition(name).constants}
        if constant not in constants:
            raise UnknownNameError(f"{name} has no constant {quote(constant)}{nearest(constant, constants)}")
        return constants[constant]

    def _paths_to(self, name: str, field: str) -> list[str]:
        level = [("", name)]
        for _ in range(3):
            paths = []
            below = []
            for prefix, record in level[:200]:
                for slot in self.slots(record).values():
                    if slot.name == field and prefix:
                        paths.append(f"{prefix}{slot.name}")
                    if isinstance(slot.type, value_types.RecordType):
                        below.append((f"{prefix}{slot.name}.", slot.type.name))
            if paths:
                return paths
            level = below
        return []


def field_type(field: Field) -> Type:
    element = PRIMITIVES.get(field.type) or value_types.RecordType(field.type)
    return value_types.VectorType(element, field.length) if field.is_array else element


def nearest(name: str, known: Iterable[str]) -> str:
    known = list(islice(known, _COMPARED))  # a file can have thousands of names and thousands of mistakes
    near = difflib.get_close_matches(name[:100], known, 1, 0.65)
    if near:
        return f"; did you mean `{near[0]}`?"
    if 0 < len(known) <= 12:
        return "; known: " + ", ".join(known)
    return ""


def quote(name: str) -> str:
    return f"`{name if len(name) <= 60 else name[:57] + '…'}`"
