"""Remember which node a monitor learned a topic from, so that it begins again with the same one."""

from dataclasses import dataclass, field

MOST = 8
"""Nodes whose bytes were not a message; more are as one that never sends a message again."""


@dataclass(eq=False, slots=True)
class Origin:
    """The nodes of a topic that a monitor declared `begin` only observes.

    When the monitor begins again, it hears only the first node until that has sent a message, and until each node
    whose bytes were not a message has sent one. So no other node takes the place of the one that failed.
    """

    first: str | None = None
    """The node of the first message since the monitor was loaded."""
    unreadable: set[str] = field(default_factory=set)
    """The nodes whose last bytes were not a message, at most one more than `MOST`."""
    waits: bool = True
    """Whether no message of the first node has come since the beginning."""

    def hears(self, node: str) -> bool:
        """Whether the monitor processes bytes of this node."""
        return (
            not self.waits or node in self.unreadable or (not self.unreadable and self.first in (None, node))
        )

    def follow(self, before: "Origin") -> None:
        self.first, self.unreadable, self.waits = before.first, before.unreadable, before.waits

    def doubt(self, node: str) -> None:
        if len(self.unreadable) <= MOST:
            self.unreadable.add(node if len(self.unreadable) < MOST else "\0")
        self.waits = True

    def read(self, node: str) -> bool:
        """Note a message that was processed; return whether it counts. Otherwise, the monitor has to begin again."""
        self.unreadable.discard(node)
        if self.unreadable or self.first not in (None, node):
            return False
        self.first, self.waits = node, False
        return True
