"""Whether a node that another host's wants to replace is still there."""

import enum
from dataclasses import dataclass

from appliance.master.graph.registry import Incarnation


class Presence(enum.Enum):
    """What came of an attempt to call a node."""

    GONE = "gone"  # it refuses connections, or cannot be reached
    SILENT = "silent"  # it takes connections and does not answer
    ANSWERS = "answers"


@dataclass(frozen=True, slots=True)
class Probe:
    """The answer to a contest's question; `patience` is seconds until a silent node is unregistered."""

    holder: Incarnation
    presence: Presence
    patience: float
