"""Serializes a compiled set: one process compiles it, and another runs it.

Reading is strict: only valid sets are accepted. Only message definitions in use are included.
"""

import inspect
from typing import Any, get_type_hints

import msgspec

from rosmop.fast.abi import CompiledModule, SetPart
from rosmop.form.compiled import Compiled
from rosmop.logics.bounded import BoundedProperty
from rosmop.logics.cfg import GrammarProperty
from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.past_monitors import ClockedPastProperty, PastProperty
from rosmop.logics.pattern import TimedPattern
from rosmop.logics.ptcaret import CaretProperty
from rosmop.logics.srs import RewritingProperty
from rosmop.logics.tfsm import TimedStateMachine
from rosmop.types.messages import MessageTypes
from roswire.definitions import Definitions
from roswire.message_text import MessageDefinition, ServiceDefinition

_PROPERTIES = {
    kind.__name__: kind
    for kind in (
        FiniteProperty, TimedStateMachine, TimedPattern, ClockedPastProperty, PastProperty, BoundedProperty,
        GrammarProperty, RewritingProperty, CaretProperty,
    )
}  # fmt: skip


def _parts(kind: type) -> Any:
    """Return the types of a property's constructor arguments, in order."""
    hints = get_type_hints(vars(kind)["__init__"])
    return tuple[tuple(hints[name] for name in list(inspect.signature(kind).parameters))]  # type: ignore[misc]  # made here


_MADE_OF = {name: _parts(kind) for name, kind in _PROPERTIES.items()}


class _Used(msgspec.Struct):
    """Collects the definitions that a set uses."""

    messages: dict[str, MessageDefinition]
    services: dict[str, ServiceDefinition]


def _plain(value: Any) -> Any:
    if isinstance(value, CompiledProperty):
        return [type(value).__name__, value.made_of]
    raise NotImplementedError(type(value).__name__)


def _made(kind: type, value: Any) -> Any:
    if kind is CompiledProperty:
        name, parts = msgspec.convert(value, tuple[str, Any])
        if name not in _PROPERTIES:
            raise ValueError(f"there is no property {name[:40]!a}")
        return _PROPERTIES[name](*msgspec.convert(parts, _MADE_OF[name]))
    if kind is MessageTypes:
        used = msgspec.convert(value, _Used)
        return MessageTypes(Definitions(used.messages, used.services))
    raise NotImplementedError(kind.__name__)


_PARTS = msgspec.msgpack.Decoder(tuple[msgspec.Raw, CompiledModule])
_DECODER = msgspec.msgpack.Decoder(Compiled, dec_hook=_made)


def encoded(compiled: Compiled) -> bytes:
    """Serialize a set; equal sets give equal bytes."""
    definitions = compiled.messages.definitions
    reached = {name for one in compiled.specifications for name in one.reached}
    reached |= {one.type for one in compiled.publications}
    services = {
        event.service_type for one in compiled.specifications for event in one.events if event.service_type
    }
    used = _Used(
        {name: definitions.message(name) for name in sorted(reached)},
        {name: definitions.service(name) for name in sorted(services)},
    )

    def plain(value: Any) -> Any:
        return used if value is compiled.messages else _plain(value)

    return msgspec.msgpack.encode(compiled, enc_hook=plain, order="deterministic")


def decoded(data: bytes) -> Compiled:
    """Deserialize a set. Raises `msgspec.ValidationError`."""
    return _DECODER.decode(data)


def encoded_part(part: SetPart) -> bytes:
    """Serialize the part of a set that one process runs; equal parts give equal bytes."""
    return msgspec.msgpack.encode((msgspec.Raw(encoded(part.compiled)), part.module))


def decoded_part(data: bytes) -> SetPart:
    """Deserialize the part of a set that one process runs. Raises `msgspec.ValidationError`."""
    compiled, module = _PARTS.decode(data)
    return SetPart(_DECODER.decode(compiled), module)
