"""The type of a topic to which a door subscribes, and its clients.

1. One type counts at a time. The version that ROS's packages or the operator define comes before the others; among
   those, the one of the first publisher counts until that publisher is gone.
2. Messages of another type are dropped, and each client gets the reason once.
3. The header of a publisher is parsed at most once, even if it cannot be used.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.features.doors.client_requests import SubscribeTopic
from appliance.features.doors.known_types import KnownType, KnownTypes, TypeKey
from appliance.features.doors.values import MessageCodec
from roswire.errors import DefinitionError, ProtocolError

Client = TypeVar("Client")
_MOST_TOLD = 8  # other types of one topic; a publisher can change its own at will


@dataclass(slots=True)
class HeardTopic(Generic[Client]):
    """A topic with its clients and the connection header that counts."""

    topic: str
    types: KnownTypes
    clients: dict[Client, SubscribeTopic] = field(default_factory=dict)
    header: Mapping[str, str] | None = None
    told: set[TypeKey] = field(default_factory=set)
    doubtful: bool = False
    """Whether the policy has changed since the master last granted the subscription."""
    _known: KnownType | None = None
    _unusable: tuple[Mapping[str, str], DefinitionError] | None = None

    def refusal(self, header: Mapping[str, str], present: Collection[TypeKey]) -> str:
        """Return why a message with this header is dropped, or an empty text; `present` has the publishers' types."""
        if header is self.header:
            return ""
        counts = None if self.header is None else TypeKey.of(self.header)
        key = TypeKey.of(header)
        if key != counts:
            if (
                counts is not None
                and counts in present
                and (self.types.defines(counts) or not self.types.defines(key))
            ):
                return two_types(self.topic, counts, key)
            self._known = self._unusable = None
        self.header = header
        return ""

    def tells(self, header: Mapping[str, str]) -> bool:
        """Return whether clients have not yet got the reason about the type of this header."""
        key = TypeKey.of(header)
        if key in self.told or len(self.told) >= _MOST_TOLD:
            return False
        self.told.add(key)
        return True

    def codec(self, header: Mapping[str, str]) -> MessageCodec:
        """Raise `DefinitionError` if the definition cannot be used."""
        return self.known(header).codec

    def known(self, header: Mapping[str, str]) -> KnownType:
        if self._known is not None and TypeKey.of(header) == (self._known.name, self._known.md5sum):
            return self._known
        if self._unusable is not None and self._unusable[0] is header:
            error = self._unusable[1]
            raise DefinitionError(error.text, error.source, error.line)
        try:
            known = self.types.learn(header)
        except DefinitionError as error:
            self._unusable = header, error.with_traceback(None)
            raise
        if header is self.header:
            self._known = known
        return known


def two_types(topic: str, counts: TypeKey, other: TypeKey) -> str:
    return (
        f"{topic} has publishers of two types: {_named(counts)} counts, messages of {_named(other)} are dropped."
        " Let all publishers use one version, or put its .msg file in msg/PACKAGE of the folder of specifications"
    )


def one_type(topic: str, headers: Collection[Mapping[str, str]], types: KnownTypes, name: str) -> KnownType:
    """Return the type `name` as all publishers of the topic define it. Raise `PeerError` in words."""
    found = {TypeKey.of(header): header for header in headers}
    if len(found) > 1:
        words = " and ".join(sorted(map(_named, found)))
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
