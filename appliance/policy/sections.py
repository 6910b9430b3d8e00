"""The sections of a policy file, one row each; to add one, add its row."""

from dataclasses import dataclass

from appliance.policy.model import Category


@dataclass(frozen=True, slots=True)
class Decider:
    """A section that decides requests of one or more categories.

    `extension` sections grant everything to everybody when they are missing (the thesis knows nothing of
    them); all others then grant nothing.
    """

    name: str
    categories: tuple[Category, ...]
    extension: bool = False


DECIDERS = (
    Decider("Nodes", (Category.NODE,)),
    Decider("Publishers", (Category.PUBLISH,)),
    Decider("Subscribers", (Category.SUBSCRIBE,)),
    Decider("Commands", (Category.COMMAND,)),
    Decider("Services", (Category.OFFER,), extension=True),
    Decider("Clients", (Category.CALL,), extension=True),
    Decider("Parameters", (Category.READ, Category.WRITE), extension=True),
)

BY_CATEGORY = {category: decider for decider in DECIDERS for category in decider.categories}

PARAMETERS = frozenset({Category.READ, Category.WRITE})
"""The categories whose resources are keys of parameters."""

DEFAULT = "default"
"""The key for what no other key of a section matches."""

GROUPS, PORTS, MONITOR, LIMITS, OPTIONS = "Groups", "Ports", "Monitor", "Limits", "Options"

NAMES = (GROUPS, PORTS, MONITOR, *(decider.name for decider in DECIDERS), LIMITS, OPTIONS)

PHRASES = {
    Category.NODE: "use the node name",
    Category.PUBLISH: "publish",
    Category.SUBSCRIBE: "subscribe to",
    Category.COMMAND: "call",
    Category.OFFER: "offer the service",
    Category.CALL: "call the service",
    Category.READ: "read the parameter",
    Category.WRITE: "write the parameter",
}
"""What a request does, for the sentence of a decision; the resource follows."""
