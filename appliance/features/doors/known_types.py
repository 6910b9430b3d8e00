"""The message and service types that a door knows.

1. A name has the definition of ROS's own packages or of the operator's files. A header never replaces it.
2. A definition in a connection header counts for messages with this header only, so it is found by its whole text:
   types with different layouts can have one md5sum, and any publisher can write such a type.
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

from appliance.features.doors.client_frames import ClientFrame, frame_size
from appliance.features.doors.values import MessageCodec, ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.tcpros import Body

Form = TypeVar("Form", bound=Hashable)
_FRAME_OVERHEAD = 500  # bytes that a shared frame takes besides its own and those of its message

MAX_CHARACTERS = 500_000
"""The most characters of all definitions and layouts. A codec takes up to 140 bytes for each of its own."""
_MAX_DEFINED_CHARACTERS = 100_000  # of them: of types that are found by their name
_MAX_FAILURES = 1000
_MAX_READ = 1000  # definitions of which the fingerprint is kept
_MAX_DIFFERING = 8


class TypeKey(NamedTuple):
    """A type as a connection header describes it."""

    name: str
    md5sum: str
    fingerprint: str
    """The fingerprint of the definition; empty if there is none that can be read."""


class _TextKey(NamedTuple):
    """A definition as a publisher sent it, with its comments."""

    name: str
    md5sum: str
    text: bytes
    """The SHA-256 of the text; empty for the definition of ROS or the operator."""

    @classmethod
    def of(cls, header: Mapping[str, str]) -> "_TextKey":
        text = header.get("message_definition", "").encode("utf-8", "surrogateescape")
        return cls(header.get("type", ""), header.get("md5sum", ""), hashlib.sha256(text).digest())


class Differing(NamedTuple):
    """Two definitions with one name and one md5sum, each with the first publisher that sent it.

    The publisher is the name of its node and the topic; both are empty for the definition of ROS or the operator.
    """

    name: str
    md5sum: str
    earlier: tuple[str, str]
    later: tuple[str, str]


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class KnownType:
    """A type that can be used; `defined` if ROS's packages or the operator define it."""

    key: TypeKey
    codec: MessageCodec
    definitions: Definitions
    defined: bool
    characters: int

    @property
    def name(self) -> str:
        return self.key.name

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
    type_of: Callable[[Mapping[str, str]], KnownType] = field(repr=False)
    shared: "SharedFrames | None" = field(default=None, repr=False)
    """The frames that other clients with this message share; None if there is only one client."""

    @property
    def type(self) -> KnownType:
        return self.type_of(self.header)

    def frame(self, form: Form, make: Callable[["DoorMessage", Form], ClientFrame]) -> ClientFrame:
        """Return the frame that `make` makes in this form, which clients with the same form share."""
        return make(self, form) if self.shared is None else self.shared.frame(self, form, make)


class SharedFrames:
    """Keeps the latest frames for other clients of the door: at most `most` bytes, with their messages."""

    def __init__(self, most: int = 16 << 20) -> None:
        self.bytes = 0
        self._most = most
        self._kept: OrderedDict[tuple[DoorMessage, Hashable], ClientFrame] = OrderedDict()  # oldest first

    def frame(
        self, message: DoorMessage, form: Form, make: Callable[[DoorMessage, Form], ClientFrame]
    ) -> ClientFrame:
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


def _kept_bytes(message: DoorMessage, frame: ClientFrame) -> int:
    return len(message.body) + frame_size(frame) + _FRAME_OVERHEAD


class _Cache:
    """The most recently used types. Those that are in use elsewhere count even after they are dropped here."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: OrderedDict[_TextKey, KnownType] = OrderedDict()  # oldest first
        self._alive: WeakValueDictionary[_TextKey, KnownType] = WeakValueDictionary()

    def find(self, key: _TextKey) -> KnownType | None:
        known = self._alive.get(key)
        if known is not None:
            self._kept[key] = known
            self._kept.move_to_end(key)
        return known

    def keep(self, key: _TextKey, known: KnownType, *, beyond: bool) -> None:
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
        self._kept[key] = self._alive[key] = known

    def forget(self) -> None:
        self._kept.clear()
        self._alive.clear()

    def _used(self) -> int:
        return sum(one.characters for one in self._alive.values())


class KnownTypes:
    """The types of one door. Methods raise `DefinitionError` for types that cannot be used."""

    def __init__(
        self, standard: Definitions, limits: ValueLimits, *, most_characters: int = MAX_CHARACTERS
    ) -> None:
        self._standard = self._definitions = standard
        self._limits = limits
        self._defined = _Cache(_MAX_DEFINED_CHARACTERS)
        self._heard = _Cache(most_characters - _MAX_DEFINED_CHARACTERS)
        self._failed: OrderedDict[_TextKey, DefinitionError] = OrderedDict()  # oldest first
        self._read: OrderedDict[_TextKey, TypeKey] = OrderedDict()  # oldest first
        self._first: OrderedDict[tuple[str, str], tuple[str, tuple[str, str]]] = OrderedDict()
        self._differing: list[Differing] = []

    def define(self, given: Definitions) -> None:
        self._definitions = self._standard.merge(given)
        self._defined.forget()
        self._failed.clear()

    def has_message(self, name: str) -> bool:
        """Return whether ROS's packages or the operator define a type of this name."""
        return name in self._definitions.message_names

    def defines(self, key: TypeKey) -> bool:
        """Return whether ROS's packages or the operator define this type, in this version.

        A definition that cannot be read, or is left out, says nothing against it.
        """
        if not self.has_message(key.name):
            return False
        try:
            return self._definitions.md5sum(key.name) == key.md5sum and (
                key.fingerprint in ("", self.message(key.name).key.fingerprint)
            )
        except DefinitionError:
            return False

    def key(self, header: Mapping[str, str]) -> TypeKey:
        """Return the type of a connection; a definition is parsed once."""
        return self._parse(_TextKey.of(header), header)[0]

    def learn(self, header: Mapping[str, str]) -> KnownType:
        """Return the type of the messages of a connection."""
        text = _TextKey.of(header)
        key, definitions = self._parse(text, header)
        if self.defines(key):
            return self.message(key.name)
        if (known := self._heard.find(text)) is not None:
            return known
        known = self._once(text, lambda: self._learn(key, definitions, header))
        self._heard.keep(text, known, beyond=False)
        return known

    def _once(self, text: _TextKey, make: Callable[[], KnownType]) -> KnownType:
        """Make a type. One that cannot be made is remembered."""
        if (earlier := self._failed.get(text)) is not None:
            raise DefinitionError(earlier.text, earlier.source, earlier.line)
        try:
            return make()
        except DefinitionError as error:
            self._failed[text] = error.with_traceback(None)
            while len(self._failed) > _MAX_FAILURES:
                self._failed.popitem(last=False)
            raise

    def _parse(self, text: _TextKey, header: Mapping[str, str]) -> tuple[TypeKey, Definitions | None]:
        """Return the type, and its definitions if they were parsed just now."""
        if (key := self._read.get(text)) is not None:
            self._read.move_to_end(text)
            return key, None
        definitions, fingerprint = None, ""
        try:
            definitions = Definitions.from_full_text(text.name, header.get("message_definition", ""))
            if definitions.md5sum(text.name) == text.md5sum:
                fingerprint = definitions.fingerprint(text.name)
        except DefinitionError:
            definitions = None
        key = self._read[text] = TypeKey(text.name, text.md5sum, fingerprint)
        while len(self._read) > _MAX_READ:
            self._read.popitem(last=False)
        if fingerprint:
            self._compare(key, (header.get("callerid", ""), header.get("topic", "")))
        return key, definitions

    def _compare(self, key: TypeKey, publisher: tuple[str, str]) -> None:
        """Note a definition that differs from an earlier one with its name and md5sum."""
        row = key.name, key.md5sum
        if self.defines(key._replace(fingerprint="")):
            first = self.message(key.name).key.fingerprint, ("", "")
        else:
            first = self._first.setdefault(row, (key.fingerprint, publisher))
            while len(self._first) > _MAX_READ:
                self._first.popitem(last=False)
        if first[0] != key.fingerprint and len(self._differing) < _MAX_DIFFERING:
            self._differing.append(Differing(*row, first[1], publisher))

    def take_differing(self) -> list[Differing]:
        """Return the differences since the last call, at most `_MAX_DIFFERING`."""
        taken, self._differing = self._differing, []
        return taken

    def _learn(self, key: TypeKey, definitions: Definitions | None, header: Mapping[str, str]) -> KnownType:
        if definitions is None:
            definitions = Definitions.from_full_text(key.name, header.get("message_definition", ""))
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
        text = _TextKey(name, self._definitions.md5sum(name), b"")
        known = self._defined.find(text)
        if known is None:
            key = TypeKey(name, text.md5sum, self._definitions.fingerprint(name))
            known = self._once(text, partial(self._made, key, self._definitions, defined=True))
            self._defined.keep(text, known, beyond=True)
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
        return KnownType(key, codec, definitions, defined, size)
