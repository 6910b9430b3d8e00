"""The surroundings of a door, as its identity may see them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class VisibleGraph:
    """The names of nodes by topic and service, and the type of each topic."""

    publishers: Mapping[str, Sequence[str]]
    subscribers: Mapping[str, Sequence[str]]
    services: Mapping[str, Sequence[str]]
    types: Mapping[str, str]

    @property
    def topics(self) -> list[str]:
        return sorted({*self.publishers, *self.subscribers})


@dataclass(frozen=True, slots=True)
class SeenTopic:
    """A topic, its type, and the full text, md5sum and fingerprint of the type."""

    topic: str
    type: str
    definition: str
    md5sum: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class SeenService:
    """A service, its type, and the texts of request and response."""

    service: str
    type: str
    request: str
    response: str


@dataclass(frozen=True, slots=True)
class DoorSurroundings:
    graph: VisibleGraph
    topics: Sequence[SeenTopic]
    services: Sequence[SeenService]
    denial: str = ""
    """The reason if the master did not give the graph, or empty."""
