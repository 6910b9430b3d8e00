"""The message and service types that a door knows.

1. A name has the definition of ROS's own packages or of the operator's files. A header never replaces it.
2. A definition in a connection header counts for messages with this header only, so it is found by its md5sum.
3. A header is parsed once: a definition that cannot be used is remembered like one that can.
4. A type that is in use is never forgotten, so no publisher can make the door parse others' headers again.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, TypeVar
from weakref import WeakValueDictionary

from appliance.features.doors.client_frames import frame_size
from appliance.features.doors.png_frames import DoorFrame, PngFrame
from appliance.features.doors.values import MessageCodec, ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.tcpros import Body

Form = TypeVar("Form", bound=Hashable)
_FRAME_OVERHEAD = 500  # bytes that a shared frame takes besides its own and those of its message

MOST_CHARACTERS = 500_000
"""The most characters of all definitions and layouts. A codec takes up to 140 bytes for each of its own."""
_MOST_DEFINED_CHARACTERS = 100_000  # of them: of types that are found by their name
_MOST_FAILURES = 1000


class TypeKey(NamedTuple):
    """A type as a connection header names it."""

    name: str
    md5sum: str

    @classmethod
    def of(cls, header: Mapping[str, str]) -> "TypeKey":
        return cls(header.get("type", ""), header.get("md5sum", ""))


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class KnownType:
    """A type that can be used; `defined` if ROS's packages or the operator define it."""

    name: str
    md5sum: str
    codec: MessageCodec
    definitions: Definitions
    defined: bool
    characters: int

    @property
    def full_text(self) -> str:
        return self.definitions.full_text(self.name)


@dataclass(eq=False, slots=True)  # a frozen one takes twice as long to make, for each message
class DoorMessage:
    """A message that came on a topic, with its publisher's header.

    Encoding raises `MessageValueError`, or `DefinitionError` if the definition cannot be used.
    """

    topic: str
    body: Body
    header: Mapping[str, str]
    received: int
    """The system time in nanoseconds."""
    codec_of: Callable[[Mapping[str, str]], MessageCodec] = field(repr=False)
    shared: "SharedFrames | None" = field(default=None, repr=False)
    """The frames that other clients with this message share; None if there is only one client."""

    @property
    def codec(self) -> MessageCodec:
        return self.codec_of(self.header)

    def frame(self, form: Form, make: Callable[["DoorMessage", Form], DoorFrame]) -> DoorFrame:
        """Return the frame that `make` makes in this form, which clients with the same form share."""
        return make(self, form) if self.shared is None else self.shared.frame(self, form, make)


class SharedFrames:
    """Keeps the latest frames for other clients of the door: at most `most` bytes, with their messages."""

    def __init__(self, most: int = 16 << 20) -> None:
        self.bytes = 0
        self._most = most
        self._kept: OrderedDict[tuple[DoorMessage, Hashable], DoorFrame] = OrderedDict()  # oldest first

    def frame(
        self, message: DoorMessage, form: Form, make: Callable[[DoorMessage, Form], DoorFrame]
    ) -> DoorFrame:
        known = self._kept.get((message, form))
        if known is not None:
            return known
        made = make(message, form)
        if isinstance(made, tuple) and made[1] is message.body:  # its head is made faster than it is found
            return made
        self._kept[message, form] = made
        self.bytes += _kept_bytes(message, made)
        while self.bytes > self._most:
            (oldest, _), frame = self._kept.popitem(last=False)
            self.bytes -= _kept_bytes(oldest, frame)
        return made


def _kept_bytes(message: DoorMessage, frame: DoorFrame) -> int:
    size = frame.size if isinstance(frame, PngFrame) else frame_size(frame)
    return len(message.body) + size + _FRAME_OVERHEAD


class _Cache:
    """The most recently used types. Those that are in use elsewhere count even after they are dropped here."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: OrderedDict[TypeKey, KnownType] = OrderedDict()  # oldest first
        self._alive: WeakValueDictionary[TypeKey, KnownType] = WeakValueDictionary()

    def find(self, key: TypeKey) -> KnownType | None:
        known = self._alive.get(key)
        if known is not None:
            self._kept[key] = known
            self._kept.move_to_end(key)
        return known

    def keep(self, known: KnownType, *, beyond: bool) -> None:
        """Keep a type, and drop others. If those in use take too much, raise `DefinitionError`, unless `beyond`."""
        while self._used() + known.characters > self._most and self._kept:
            self._kept.popitem(last=False)
        used = self._used()
        if used and used + known.characters > self._most and not beyond:
            raise DefinitionError(
                f"the types of topics in use take {used} characters at this door, and this one {known.characters}; "
                f"at most {self._most}",
                known.name[:200],
            )
        self._kept[TypeKey(known.name, known.md5sum)] = known
        self._alive[TypeKey(known.name, known.md5sum)] = known

    def forget(self) -> None:
        self._kept.clear()
        self._alive.clear()

    def _used(self) -> int:
        return sum(one.characters for one in self._alive.values())


class KnownTypes:
    """The types of one door. Methods raise `DefinitionError` for types that cannot be used."""

    def __init__(
        self, standard: Definitions, limits: ValueLimits, *, most_characters: int = MOST_CHARACTERS
    ) -> None:
        self._standard = self._definitions = standard
        self._limits = limits
        self._defined = _Cache(_MOST_DEFINED_CHARACTERS)
        self._heard = _Cache(most_characters - _MOST_DEFINED_CHARACTERS)
        self._failed: OrderedDict[tuple[TypeKey, bytes], DefinitionError] = OrderedDict()  # oldest first

    def define(self, given: Definitions) -> None:
        self._definitions = self._standard.extended(given)
        self._defined.forget()
        self._failed.clear()

    def has_message(self, name: str) -> bool:
        """Return whether ROS's packages or the operator define a type of this name."""
        return name in self._definitions.message_names

    def defines(self, key: TypeKey) -> bool:
        """Return whether ROS's packages or the operator define this type, in this version."""
        if not self.has_message(key.name):
            return False
        try:
            return self._definitions.md5sum(key.name) == key.md5sum
        except DefinitionError:
            return False

    def learn(self, header: Mapping[str, str]) -> KnownType:
        """Return the type of the messages of a connection."""
        key = TypeKey.of(header)
        if self.defines(key):
            return self.message(key.name)
        if (known := self._heard.find(key)) is not None:
            return known
        text = header.get("message_definition", "")
        digest = hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()
        known = self._once((key, digest), lambda: self._parsed(key, text))
        self._heard.keep(known, beyond=False)
        return known

    def _once(self, failure: tuple[TypeKey, bytes], make: Callable[[], KnownType]) -> KnownType:
        """Make a type. One that cannot be made is remembered under `failure`."""
        if (earlier := self._failed.get(failure)) is not None:
            raise DefinitionError(earlier.text, earlier.source, earlier.line)
        try:
            return make()
        except DefinitionError as error:
            self._failed[failure] = error.with_traceback(None)
            while len(self._failed) > _MOST_FAILURES:
                self._failed.popitem(last=False)
            raise

    def _parsed(self, key: TypeKey, text: str) -> KnownType:
        definitions = Definitions.from_full_text(key.name, text)
        if definitions.md5sum(key.name) != key.md5sum:
            raise DefinitionError(
                f"the publisher's definition does not have its md5sum {key.md5sum[:32]}", key.name[:200]
            )
        return self._made(key, definitions, defined=False)

    def message(self, name: str) -> KnownType:
        """Return the type that ROS's packages or the operator define."""
        if not self.has_message(name):
            raise DefinitionError(
                "the door does not know this message type: it is not one of ROS's own packages; put its .msg file in"
                " msg/PACKAGE of the folder of specifications (rosrv monitor reload)",
                name[:200],
            )
        key = TypeKey(name, self._definitions.md5sum(name))
        known = self._defined.find(key)
        if known is None:
            made = partial(self._made, key, self._definitions, defined=True)
            known = self._once((key, b""), made)
            self._defined.keep(known, beyond=True)
        return known

    def service(self, name: str) -> tuple[KnownType, KnownType, Definitions]:
        if name not in self._definitions.service_names:
            raise DefinitionError(
                "the door does not know this service type, which is not one of ROS's own packages: put its .srv file "
                "in msg/PACKAGE of the folder of specifications (rosrv monitor reload)",
                name[:200],
            )
        service = self._definitions.service(name)
        return self.message(service.request.name), self.message(service.response.name), self._definitions

    def _made(self, key: TypeKey, definitions: Definitions, *, defined: bool) -> KnownType:
        codec = MessageCodec(definitions, key.name, self._limits)
        # A short definition can have a large layout.
        size = len(definitions.full_text(key.name)) + definitions.layout(key.name).characters
        return KnownType(key.name, key.md5sum, codec, definitions, defined, size)
