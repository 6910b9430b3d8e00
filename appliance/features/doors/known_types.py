"""The message and service types that a door knows.

A type is known if ROS's own packages define it, if a publisher sent its definition in a connection header, or if
the operator gave the file of a service.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from appliance.features.doors.client_frames import frame_size
from appliance.features.doors.png_frames import DoorFrame, PngFrame
from appliance.features.doors.values import MessageCodec, ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.tcpros import Body

Form = TypeVar("Form", bound=Hashable)
_FRAME_OVERHEAD = 500  # bytes that a shared frame takes besides its own and those of its message

_MOST_CHARACTERS = 500_000
"""The most characters of all kept definitions and layouts. A codec takes up to 140 bytes for each of its own."""


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


class KnownTypes:
    """The most recently used types of one door. Methods raise `DefinitionError` for types that cannot be used."""

    def __init__(self, standard: Definitions, limits: ValueLimits) -> None:
        self._standard = self._defined = standard
        self._limits = limits
        self._codecs: OrderedDict[tuple[str, str], tuple[MessageCodec, Definitions]] = OrderedDict()
        self._sizes: dict[tuple[str, str], int] = {}
        self._latest: dict[str, str] = {}  # the md5sum of each type that a header defined

    def define(self, given: Definitions) -> None:
        earlier, self._defined = self._defined, self._standard.extended(given)
        names = {*earlier.message_types, *self._defined.message_types}
        for name, md5sum in [key for key in self._codecs if key[0] in names]:
            del self._codecs[name, md5sum], self._sizes[name, md5sum]
            self._latest.pop(name, None)

    def learn(self, header: Mapping[str, str]) -> MessageCodec:
        name, md5sum = header.get("type", ""), header.get("md5sum", "")
        known = self._codecs.get((name, md5sum))
        if known is not None:
            self._codecs.move_to_end((name, md5sum))
            return known[0]
        definitions = Definitions.from_full_text(name, header.get("message_definition", ""))
        if definitions.md5sum(name) != md5sum:
            raise DefinitionError(
                f"the publisher's definition does not have its md5sum {md5sum[:32]}", name[:200]
            )
        return self._keep(name, md5sum, definitions)

    def message(self, name: str) -> tuple[MessageCodec, Definitions]:
        md5sum = self._latest.get(name, "")
        known = self._codecs.get((name, md5sum))
        if known is None:
            if name not in self._defined.message_types:
                raise DefinitionError(
                    "the door does not know this message type: no publisher of it has been heard, and it is not one "
                    "of ROS's own packages; put its .msg file in msg/PACKAGE of the folder of specifications "
                    "(rosrv monitor reload)",
                    name[:200],
                )
            self._keep(name, self._defined.md5sum(name), self._defined)
            known = self._codecs[name, self._latest[name]]
        self._codecs.move_to_end((name, self._latest[name]))
        return known

    def service(self, name: str) -> tuple[MessageCodec, MessageCodec, Definitions]:
        if name not in self._defined.service_types:
            raise DefinitionError(
                "the door does not know this service type, which is not one of ROS's own packages: put its .srv file "
                "in msg/PACKAGE of the folder of specifications (rosrv monitor reload)",
                name[:200],
            )
        service = self._defined.service(name)
        return (
            self.message(service.request.name)[0],
            self.message(service.response.name)[0],
            self._defined,
        )

    def _keep(self, name: str, md5sum: str, definitions: Definitions) -> MessageCodec:
        codec = MessageCodec(definitions, name, self._limits)
        self._codecs[name, md5sum] = codec, definitions
        # A short definition can have a large layout.
        self._sizes[name, md5sum] = len(definitions.full_text(name)) + definitions.layout(name).characters
        self._latest[name] = md5sum
        while sum(self._sizes.values()) > _MOST_CHARACTERS and len(self._codecs) > 1:
            (oldest, oldest_md5sum), _ = self._codecs.popitem(last=False)
            del self._sizes[oldest, oldest_md5sum]
            if self._latest.get(oldest) == oldest_md5sum:
                del self._latest[oldest]
        return codec
