"""A compiled set as bytes: what one process has compiled, and another runs.

It is read strictly: what is in it is what a set can be made of, or it is not read. Of the definitions of messages it
has those that its specifications use.
"""

import inspect
from typing import Any, get_type_hints

import msgspec

from rosmop.fast.abi import FeedModule, Part
from rosmop.form.compiled import Compiled
from rosmop.logics.bounded import BoundedProperty
from rosmop.logics.cfg import GrammarProperty
from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.past_monitors import ClockedPast, PastProperty
from rosmop.logics.pattern import TimedPattern
from rosmop.logics.ptcaret import CaretProperty
from rosmop.logics.srs import RewritingProperty
from rosmop.logics.tfsm import TimedMachine
from rosmop.types.messages import Messages
from roswire.definitions import Definitions
from roswire.message_text import MessageDefinition, ServiceDefinition

_PROPERTIES = {
    kind.__name__: kind
    for kind in (
        FiniteProperty, TimedMachine, TimedPattern, ClockedPast, PastProperty, BoundedProperty, GrammarProperty,
        RewritingProperty, CaretProperty,
    )
}  # fmt: skip


def _parts(kind: type) -> Any:
    """The types of what a property is made of, in order."""
    hints = get_type_hints(vars(kind)["__init__"])
    return tuple[tuple(hints[name] for name in list(inspect.signature(kind).parameters))]  # type: ignore[misc]  # made here


_MADE_OF = {name: _parts(kind) for name, kind in _PROPERTIES.items()}


class _Used(msgspec.Struct):
    """The definitions that a set uses."""

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
    if kind is Messages:
        used = msgspec.convert(value, _Used)
        return Messages(Definitions(used.messages, used.services))
    raise NotImplementedError(kind.__name__)


_PARTS = msgspec.msgpack.Decoder(tuple[msgspec.Raw, FeedModule])
_DECODER = msgspec.msgpack.Decoder(Compiled, dec_hook=_made)


def encoded(compiled: Compiled) -> bytes:
    """The set as bytes: of the same set always the same."""
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
    """The set again. Raises `msgspec.ValidationError`."""
    return _DECODER.decode(data)


def encoded_part(part: Part) -> bytes:
    """What one process runs as bytes: of the same always the same."""
    return msgspec.msgpack.encode((msgspec.Raw(encoded(part.compiled)), part.module))


def decoded_part(data: bytes) -> Part:
    """What one process runs. Raises `msgspec.ValidationError`."""
    compiled, module = _PARTS.decode(data)
    return Part(_DECODER.decode(compiled), module)
