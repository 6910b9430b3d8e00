"""Remember the nodes from which a monitor learned a topic, so that it begins again with the same ones."""

from collections.abc import Collection
from dataclasses import dataclass, field

MAX = 8
"""Nodes that are remembered; more are as one that never sends a message again."""


@dataclass(eq=False, slots=True)
class Origin:
    """The nodes of a topic that a monitor declared `begin` only observes.

    When the monitor begins again, it hears only the first node until that has sent a message, and until each node
    whose bytes were not a message has sent one. So no other node takes the place of the one that failed.

    If each node has a say of its own (`speakers`), the monitor hears all of them, and cannot judge before each node
    that it knew has sent a message again. So what one said is not forgotten for the others.
    """

    first: str | None = None
    """The node of the first message since the monitor was loaded."""
    unreadable: set[str] = field(default_factory=set)
    """The nodes whose last bytes were not a message, at most one more than `MAX`; of speakers, all that it awaits."""
    waits: bool = True
    """Whether no message of the first node has come since the beginning."""
    speakers: bool = False
    known: set[str] = field(default_factory=set)
    """The speakers that have sent a message, at most one more than `MAX`."""

    @property
    def awaited(self) -> Collection[str]:
        """Return the nodes without whose messages the monitor does not go on."""
        if not self.waits or self.unreadable or self.first is None:
            return sorted(self.unreadable)
        return [self.first]

    @property
    def blocks(self) -> bool:
        """Whether the monitor cannot judge yet."""
        return self.speakers and bool(self.unreadable)

    def hears(self, node: str) -> bool:
        """Whether the monitor processes bytes of this node."""
        if not self.waits or self.speakers or node in self.unreadable:
            return True
        return not self.unreadable and self.first in (None, node)

    def begin_again(self) -> None:
        self.waits = True
        if self.speakers:
            self.unreadable |= self.known

    def forget(self) -> None:
        """Hear any node, as after the monitor was loaded."""
        self.first, self.waits = None, True
        self.unreadable.clear()
        self.known.clear()

    def follow(self, before: "Origin") -> None:
        self.first, self.unreadable, self.waits = before.first, before.unreadable, before.waits
        self.known = before.known

    def doubt(self, node: str) -> None:
        _remember(self.unreadable, node)
        self.waits = True

    def read(self, node: str) -> bool:
        """Note a message that was processed; return whether it counts. Otherwise, the monitor has to begin again."""
        self.unreadable.discard(node)
        if self.speakers:
            _remember(self.known, node)
            self.first, self.waits = self.first or node, bool(self.unreadable)
            return True
        if self.unreadable or self.first not in (None, node):
            return False
        self.first, self.waits = node, False
        return True


def _remember(nodes: set[str], node: str) -> None:
    if node not in nodes and len(nodes) <= MAX:
        nodes.add(node if len(nodes) < MAX else "\0")
