"""Make a host's kit from control's answer and the given options, for REST and the command line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from appliance.features.tunnels.enrolment_kit import Kit
from appliance.features.tunnels.tunnel_answers import KitParts
from appliance.network.close_ports import parse_ports, parse_services, protection, through_tunnel_only


@dataclass(frozen=True)
class KitOptions:
    """The options of a kit; `opened` are services that stay open."""

    endpoint: str
    ports: str = "32768-60999"
    opened: Sequence[str] = ()

    def __post_init__(self) -> None:
        parse_ports(self.ports)
        parse_services(self.opened)

    @classmethod
    def of(cls, kept: Mapping[str, str]) -> "KitOptions":
        return cls(kept["endpoint"], kept["ports"], tuple(filter(None, kept["open"].split(","))))


def kit_of(body: KitParts, wishes: KitOptions, key: str | None) -> Kit:
    ports, opened = parse_ports(wishes.ports), parse_services(wishes.opened)
    protect = protection([body.appliance], ports, opened) + through_tunnel_only(body.appliance)
    return Kit(body, wishes.endpoint, protect, key)
