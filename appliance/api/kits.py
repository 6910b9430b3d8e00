"""A host's kit out of control's answer and the wishes of whoever asked: the same over REST and on the command line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from appliance.channel.answers.host_answers import KitParts
from appliance.ipsec.enrolment_kit import Kit
from appliance.network.close_ports import parse_ports, parse_services, protection


@dataclass(frozen=True)
class Wishes:
    """What goes into a kit besides certificates: where the host reaches the appliance, its ports, what stays open."""

    endpoint: str
    ports: str = "32768-60999"
    opened: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Raises `ValueError`, naming what is wrong."""
        parse_ports(self.ports)
        parse_services(self.opened)

    @classmethod
    def of(cls, kept: Mapping[str, str]) -> "Wishes":
        """What was kept."""
        return cls(kept["endpoint"], kept["ports"], tuple(filter(None, kept["open"].split(","))))


def kit_of(body: KitParts, wishes: Wishes, key: str | None) -> Kit:
    """The kit of a host that control has enrolled; `key` None: the host has it."""
    ports, opened = parse_ports(wishes.ports), parse_services(wishes.opened)
    return Kit(body, wishes.endpoint, protection([body.appliance], ports, opened, tunnelled=True), key)
