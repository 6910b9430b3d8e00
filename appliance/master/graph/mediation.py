"""What goes through the relay, and whose URIs nodes are told.

The default, all and full, is the boundary. `relaying: monitored` is the thesis's mode: only topics and services that
the policy's `[Monitor]` names, or a specification has events on, are carried, the rest is negotiated between the
nodes; `mediation: monitored` (only with it) also tells nodes each other's real URIs. Both are a choice for speed, not a
boundary: a node that has been told a port can ask it for anything.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.policy.policy import Policy
from appliance.specifications.specification_files import Checked


@dataclass(frozen=True, slots=True)
class Mediation:
    """The two modes, over the running policy."""

    policy: Callable[[], Policy]
    specifications: Callable[[], Checked]
    relay_all: bool = True
    stand_ins: bool = True

    def carries_topic(self, topic: str) -> bool:
        """Whether the relay carries a topic."""
        return (
            self.relay_all
            or topic in self.policy().monitored_topics
            or self.policy().limit_rule(topic) is not None
            or self.specifications().of_topic(topic)
        )

    def carries_service(self, service: str) -> bool:
        """Whether the relay carries a service."""
        return (
            self.relay_all
            or service in self.policy().monitored_services
            or self.specifications().of_service(service)
        )

    def hides_publishers(self, topic: str) -> bool:
        """Whether subscribers of a topic are told the publishers' outer URIs (else the real ones)."""
        return self.stand_ins or self.carries_topic(topic)
