"""The table of sections of a policy file. To add a section, add a row."""

from collections.abc import Mapping
from dataclasses import dataclass

from appliance.policy.model import Category


@dataclass(frozen=True, slots=True)
class Decider:
    """A section that decides requests; `phrases` are the words before a resource in messages.

    The sections with `extension` are not in the thesis: if one is missing, its requests are allowed for all hosts.
    """

    name: str
    phrases: Mapping[Category, str]
    extension: bool = False

    @property
    def categories(self) -> tuple[Category, ...]:
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

ASK = "ask"
"""The word before hosts that need an operator's approval."""

ASKING = frozenset({Category.PUBLISH, Category.CALL, Category.WRITE})

DEFAULT = "default"
"""The key for names without another matching key in the section."""

GROUPS, PORTS, MONITOR, LIMITS, OPTIONS = "Groups", "Ports", "Monitor", "Limits", "Options"
AUTHORITY, HOURS = "Authority", "Hours"

NAMES = (GROUPS, PORTS, MONITOR, *(decider.name for decider in DECIDERS), LIMITS, AUTHORITY, HOURS, OPTIONS)
