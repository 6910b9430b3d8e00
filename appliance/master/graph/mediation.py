"""Decide which topics and services are relayed, and which URIs nodes get.

The default, `relaying: all` and `mediation: full`, is a security boundary. The other modes are faster, but not a
boundary: a node that knows a port can send any request to it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.policy.model import Category
from appliance.policy.policy import Policy
from appliance.specifications.specification_files import CheckedSpecifications


@dataclass(frozen=True, slots=True)
class Mediation:
    """The two modes, applied to the policy in force."""

    policy: Callable[[], Policy]
    specifications: Callable[[], CheckedSpecifications]
    relay_all: bool = True
    stand_ins: bool = True

    def carries_topic(self, topic: str) -> bool:
        return (
            self.relay_all
            or topic in self.policy().monitored_topics
            or self.policy().limit_rule(topic) is not None
            or self.policy().commanded(topic) is not None
            or self.policy().asks_for(Category.PUBLISH, topic)
            or self.specifications().of_topic(topic)
        )

    def carries_service(self, service: str) -> bool:
        return (
            self.relay_all
            or service in self.policy().monitored_services
            or self.policy().commanded(service) is not None
            or self.policy().asks_for(Category.CALL, service)
            or self.specifications().of_service(service)
        )

    def hides_publishers(self, topic: str) -> bool:
        return self.stand_ins or self.carries_topic(topic)
