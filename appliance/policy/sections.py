"""The sections of a policy file, one row each; to add one, add its row."""

from collections.abc import Mapping
from dataclasses import dataclass

from appliance.policy.model import Category


@dataclass(frozen=True, slots=True)
class Decider:
    """A section that decides requests. `phrases` has its categories, with the words before the name of the resource.

    A missing `extension` section grants everything to all hosts (the thesis does not have these sections); any other
    missing section grants nothing.
    """

    name: str
    phrases: Mapping[Category, str]
    extension: bool = False

    @property
    def categories(self) -> tuple[Category, ...]:
        """Return the categories that it decides."""
        return tuple(self.phrases)


DECIDERS = (
    Decider("Nodes", {Category.NODE: "use the node name"}),
    Decider("Publishers", {Category.PUBLISH: "publish"}),
    Decider("Subscribers", {Category.SUBSCRIBE: "subscribe to"}),
    Decider("Commands", {Category.COMMAND: "call"}),
    Decider("Services", {Category.OFFER: "offer the service"}, extension=True),
    Decider("Clients", {Category.CALL: "call the service"}, extension=True),
    Decider(
        "Parameters",
        {Category.READ: "read the parameter", Category.WRITE: "write the parameter"},
        extension=True,
    ),
)

BY_CATEGORY = {category: decider for decider in DECIDERS for category in decider.categories}

PARAMETERS = frozenset({Category.READ, Category.WRITE})
"""The categories whose resources are keys of parameters."""

DEFAULT = "default"
"""The key for names that no other key of a section matches."""

GROUPS, PORTS, MONITOR, LIMITS, OPTIONS = "Groups", "Ports", "Monitor", "Limits", "Options"

NAMES = (GROUPS, PORTS, MONITOR, *(decider.name for decider in DECIDERS), LIMITS, OPTIONS)
