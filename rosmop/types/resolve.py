"""Resolve the type names of a specification. Unknown names raise `SpecificationError`."""

from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes, UnknownNameError, nearest
from rosmop.types.value_types import Type

_SIGNED = {
    "char": value_types.CHAR,
    "short": value_types.INT16,
    "int": value_types.INT,
    "long": value_types.LONG,
}
_UNSIGNED = {
    "char": value_types.UINT8,
    "short": value_types.UINT16,
    "int": value_types.UINT,
    "long": value_types.ULONG,
}
_NAMED: dict[tuple[str, ...], Type] = {
    ("string",): value_types.STRING,
    ("ros", "Time"): value_types.TIME,
    ("ros", "Duration"): value_types.DURATION,
    ("size_t",): value_types.ULONG,
    ("int8_t",): value_types.INT8,
    ("uint8_t",): value_types.UINT8,
    ("int16_t",): value_types.INT16,
    ("uint16_t",): value_types.UINT16,
    ("int32_t",): value_types.INT,
    ("uint32_t",): value_types.UINT,
    ("int64_t",): value_types.LONG,
    ("uint64_t",): value_types.ULONG,
}
_CPP_NAMES = {  # C++ names of the field types that .msg files name
    **{f"{sign}int{bits}": f"{sign}int{bits}_t" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "float32": "float",
    "float64": "double",
    "byte": "int8_t",
    "time": "ros::Time",
    "duration": "ros::Duration",
}
_SHORT_NAMES = {short: f"unsigned {short[1:]}" for short in ("uint", "ushort", "ulong")}  # of glibc


def named_type(parts: tuple[str, ...]) -> Type | None:
    """Return the type of a name such as `std::string`, `size_t` or `ros::Time`; None for a message type."""
    return _NAMED.get(parts[1:] if parts[0] == "std" and len(parts) > 1 else parts)


def resolve(name: tree.TypeName, messages: MessageTypes) -> Type:
    if name.element is not None:
        element = resolve(name.element, messages)
        if element in (value_types.VOID, value_types.CHARACTERS):
            raise SpecificationError.at(name.position, f"there are no vectors of {element}")
        return value_types.VectorType(element)
    built_in = _built_in(name)
    if name.pointer:
        if built_in != value_types.CHAR:
            raise SpecificationError.at(
                name.position, f"there are no pointers except `char *`; write `{' '.join(name.name)}`"
            )
        return value_types.CHARACTERS
    return built_in or named_type(name.name) or _message(name, messages)


def _built_in(name: tree.TypeName) -> Type | None:
    words = list(name.name)
    if words == ["void"]:
        return value_types.VOID
    if words == ["bool"]:
        return value_types.BOOL
    if words in (["float"], ["double"], ["long", "double"]):
        return value_types.FLOAT if words == ["float"] else value_types.DOUBLE
    if not set(words) <= {"char", "short", "int", "long", "signed", "unsigned"}:
        if len(words) > 1 and words[0] in ("unsigned", "signed", "long", "short"):
            raise SpecificationError.at(name.position, f"`{' '.join(words)}` is not a type")
        return None
    signs = [word for word in words if word in ("signed", "unsigned")]
    sizes = [word for word in words if word in ("char", "short", "long")]
    known: tuple[list[str], ...] = ([], ["char"], ["short"], ["long"], ["long", "long"])
    too_many = words.count("int") > 1 or len(signs) > 1 or ("char" in words and "int" in words)
    if sizes not in known or too_many:
        raise SpecificationError.at(name.position, f"`{' '.join(words)}` is not a type")
    if words == ["signed", "char"]:
        return value_types.INT8
    table = _UNSIGNED if signs == ["unsigned"] else _SIGNED
    return table[sizes[0] if sizes else "int"]


def _message(name: tree.TypeName, messages: MessageTypes) -> Type:
    text = "::".join(name.name)
    if text in _CPP_NAMES:
        raise SpecificationError.at(
            name.position, f"unknown type `{text}`; ROS's {text} is `{_CPP_NAMES[text]}` in C++: write that"
        )
    if text in _SHORT_NAMES:
        raise SpecificationError.at(name.position, f"unknown type `{text}`; write `{_SHORT_NAMES[text]}`")
    if len(name.name) != 2 or name.name[0] == "std":
        raise SpecificationError.at(name.position, f"unknown type `{text}`{_meant(name.name, messages)}")
    return record(name.position, "/".join(name.name), messages)


def _meant(parts: tuple[str, ...], messages: MessageTypes) -> str:
    advice = instead(parts)
    if advice is not None:
        return f"; {advice}"
    named = [known for known in messages.definitions.message_types if known.endswith(f"/{parts[-1]}")]
    if named and len(parts) == 1:
        return f"; did you mean `{named[0].replace('/', '::')}`?"
    hint = nearest(parts[-1], ["bool", "int", "double", "float", "char", "string", "size_t"])
    return hint if "did you mean" in hint else "; write a C++ type or a message type `package::Type`"


def record(position: Position, name: str, messages: MessageTypes) -> value_types.RecordType:
    try:
        messages.definition(name)
    except UnknownNameError as error:
        advice = instead(name.split("/")) if name not in messages.definitions.message_types else None
        text = f"there is no `{name.replace('/', '::')}`; {advice}" if advice else str(error)
        raise SpecificationError.at(position, text) from None
    return value_types.RecordType(name)
