"""The section `doors` of `appliance.yaml`."""

import ipaddress
from typing import Annotated, ClassVar

from appliance.configuration.quantities import Count, rules
from appliance.configuration.sections import FeatureSection, key, section

MAX_DOORS = 32
"""The most doors at the same time; each has a process."""


@section
class Doors(FeatureSection):
    """Doors for browsers, Foxglove and agents. `rosrv door add` adds a door; without one, nothing listens."""

    place: ClassVar[str] = "doors"
    network: str = key(
        default="198.19.240.0/20",
        description="addresses of doors inside the appliance; no other machine has or reaches them",
    )
    origins: list[str] = key(
        default=[],
        description="pages that may connect, as https://NAME[:PORT]; the page of the appliance itself always may",
    )
    connections: Annotated[Count, rules(le=200)] = key(
        default=32, description="connections of one door at the same time"
    )
    connections_in_ten_seconds: Count = key(default=200, description="new connections of one door")

    def __post_init__(self) -> None:
        network = ipaddress.IPv4Network(self.network)
        if network.prefixlen > 29 or not network.is_private or network.is_loopback:
            raise ValueError(f"network is {network}: give a private IPv4 network of at least 8 addresses")

    @property
    def gateway(self) -> str:
        """Return the address at which doors reach the appliance if it listens on all addresses."""
        return str(ipaddress.IPv4Network(self.network).network_address + 1)
