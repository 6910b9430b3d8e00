"""Serialize a compiled set: one process compiles it, and another runs it.

Equal sets give equal bytes. Reading accepts only valid sets, and otherwise raises `msgspec.ValidationError`.
"""

from typing import Any, get_type_hints

import msgspec

from rosmop.fast.abi import CompiledModule, SetPart
from rosmop.form.compiled import Compiled
from rosmop.logics.catalogue import LOGICS
from rosmop.logics.interface import CompiledProperty
from rosmop.types.messages import MessageTypes
from roswire.definitions import Definitions
from roswire.message_text import MessageDefinition, ServiceDefinition


def _parts(kind: Any) -> Any:
    hints = get_type_hints(kind.__init__)
    return tuple[tuple(hint for name, hint in hints.items() if name != "return")]  # type: ignore[misc]  # made here


_MADE_OF = {kind: _parts(kind) for logic in LOGICS.values() for kind in logic.properties}


class _Used(msgspec.Struct):
    messages: dict[str, MessageDefinition]
    services: dict[str, ServiceDefinition]


def _plain(value: object) -> object:
    if isinstance(value, CompiledProperty):
        kinds = LOGICS[value.logic].properties
        if type(value) not in kinds:
            raise TypeError(f"the row of `{value.logic}` in `LOGICS` has no {type(value).__name__}")
        return [value.logic, kinds.index(type(value)), value.made_of]
    raise NotImplementedError(type(value).__name__)


def _make(kind: type, value: object) -> object:
    if kind is CompiledProperty:
        logic, number, parts = msgspec.convert(value, tuple[str, int, Any])
        if logic not in LOGICS or not 0 <= number < len(LOGICS[logic].properties):
            raise ValueError(f"there is no property {number} of {logic[:40]!a}")
        made = LOGICS[logic].properties[number]
        return made(*msgspec.convert(parts, _MADE_OF[made]))
    if kind is MessageTypes:
        used = msgspec.convert(value, _Used)
        return MessageTypes(Definitions(used.messages, used.services))
    raise NotImplementedError(kind.__name__)


_PARTS = msgspec.msgpack.Decoder(tuple[msgspec.Raw, CompiledModule])
_DECODER = msgspec.msgpack.Decoder(Compiled, dec_hook=_make)


def encode(compiled: Compiled) -> bytes:
    definitions = compiled.messages.definitions
    reached = {name for specification in compiled.specifications for name in specification.reached}
    reached |= {publication.type for publication in compiled.publications}
    services = {
        event.service_type for one in compiled.specifications for event in one.events if event.service_type
    }
    services |= {call.type for call in compiled.calls}
    used = _Used(
        {name: definitions.message(name) for name in sorted(reached)},
        {name: definitions.service(name) for name in sorted(services)},
    )

    def plain(value: object) -> object:
        return used if value is compiled.messages else _plain(value)

    return msgspec.msgpack.encode(compiled, enc_hook=plain, order="deterministic")


def decode(data: bytes) -> Compiled:
    return _DECODER.decode(data)


def encoded_part(part: SetPart) -> bytes:
    return msgspec.msgpack.encode((msgspec.Raw(encode(part.compiled)), part.module))


def decoded_part(data: bytes) -> SetPart:
    compiled, module = _PARTS.decode(data)
    return SetPart(_DECODER.decode(compiled), module)
