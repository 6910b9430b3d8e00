"""The type of a topic to which a door subscribes, and its clients.

1. One type counts at a time. The version that ROS's packages or the operator define comes before the others, then
   that of a publisher on the robot's machine; among the rest, the one of the first publisher counts until it is gone.
2. Messages of another type are dropped, and each client gets the reason once, also a later client.
3. A type is another one if its definition says anything else, even with the same md5sum.
4. The header of a publisher is parsed at most once, even if it cannot be used.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.features.doors.client_requests import SubscribeTopic
from appliance.features.doors.known_types import KnownType, KnownTypes, TypeKey
from roswire.errors import DefinitionError, ProtocolError

Client = TypeVar("Client")
_MAX_TOLD = 8  # other types of one topic; a publisher can change its own at will
_DESCRIBE = ("type", "md5sum", "message_definition")


@dataclass(slots=True)
class HeardTopic(Generic[Client]):
    """A topic with its clients and the connection header that counts."""

    topic: str
    types: KnownTypes
    clients: dict[Client, SubscribeTopic] = field(default_factory=dict)
    header: Mapping[str, str] | None = None
    told: dict[TypeKey, str] = field(default_factory=dict)
    """The reasons that clients got, by types that do not count."""
    doubtful: bool = False
    """Whether the policy has changed since the master last granted the subscription."""
    _known: tuple[Mapping[str, str], KnownType] | None = None
    _unusable: tuple[Mapping[str, str], DefinitionError] | None = None

    def refusal(self, header: Mapping[str, str], present: Callable[[], Collection[TypeKey]]) -> str:
        """Return why a message with this header is dropped, or an empty text; `present` gives the publishers' types."""
        if self.header is not None and not same_text(header, self.header):
            counts, key = self.types.key(self.header), self.types.key(header)
            if key != counts:
                kept = self.types.defines(counts) or not self.types.defines(key)
                if kept and counts in present():
                    return two_types(self.topic, counts, key)
                self._known = self._unusable = None
        self.header = header
        return ""

    def put_first(self, header: Mapping[str, str]) -> None:
        """Let this type count."""
        self.header = header
        self._known = self._unusable = None

    def tells(self, header: Mapping[str, str], reason: str) -> bool:
        """Return whether clients have not yet got the reason about the type of this header."""
        key = self.types.key(header)
        if key in self.told or len(self.told) >= _MAX_TOLD:
            return False
        self.told[key] = reason
        return True

    def known_type(self, header: Mapping[str, str]) -> KnownType:
        """Raise `DefinitionError` if the definition cannot be used."""
        if self._known is not None and same_text(header, self._known[0]):
            return self._known[1]
        if self._unusable is not None and self._unusable[0] is header:
            error = self._unusable[1]
            raise DefinitionError(error.text, error.source, error.line)
        try:
            known = self.types.learn(header)
        except DefinitionError as error:
            self._unusable = header, error.with_traceback(None)
            raise
        if header is self.header:
            self._known = header, known
        return known


def same_text(one: Mapping[str, str], other: Mapping[str, str]) -> bool:
    return one is other or all(one.get(name) == other.get(name) for name in _DESCRIBE)


def two_types(topic: str, counts: TypeKey, other: TypeKey) -> str:
    return (
        f"{topic} has publishers of two types: {_named(counts)} counts, messages of {_other(counts, other)} are"
        " dropped. Let all publishers use one version, or put its .msg file in msg/PACKAGE of the folder of"
        " specifications"
    )


def one_type(topic: str, headers: Collection[Mapping[str, str]], types: KnownTypes, name: str) -> KnownType:
    """Return the type `name` as all these publishers of the topic define it. Raise `PeerError` in words."""
    found = {types.key(header): header for header in headers}
    if len(found) > 1:
        first, *others = found
        words = " and ".join([_named(first), *(_other(first, key) for key in others)])
        raise ProtocolError(f"{topic} has publishers of two types, {words}: use one version")
    for key, header in found.items():
        if key.name != name:
            raise ProtocolError(f"{topic} has the type {key.name[:200]}, not {name[:200]}: use that type")
        return types.learn(header)
    raise DefinitionError(
        f"the door does not know this message type: no publisher of {topic} has been heard, and it is not one of"
        " ROS's own packages; put its .msg file in msg/PACKAGE of the folder of specifications (rosrv monitor reload)",
        name[:200],
    )


def _named(key: TypeKey) -> str:
    return f"{key.name[:200]} with the md5sum {key.md5sum[:32]}"


def _other(counts: TypeKey, other: TypeKey) -> str:
    if counts[:2] == other[:2]:
        return f"another definition of {other.name[:200]} with the same md5sum"
    return _named(other)
