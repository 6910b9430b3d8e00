"""Define the interface of the firewall's back ends."""

from dataclasses import dataclass
from typing import Protocol

from appliance.network.firewall.firewall_rules import Family, PacketRule
from appliance.network.namespaces import NetworkError


class FirewallError(NetworkError):
    """The kernel or its tools reject the rules, or do not enforce them."""


class BackendMissingError(FirewallError):
    """The back end lacks a program, a library or a part of the kernel."""


@dataclass(frozen=True)
class RuleCounter:
    chain: str
    family: Family | None  # None: one rule for both families
    purpose: str
    packets: int
    octets: int


class Backend(Protocol):
    """A back end for one namespace."""

    @property
    def name(self) -> str: ...

    @property
    def families(self) -> tuple[Family, ...]:
        """The families that the kernel supports."""

    def install(self, rules: tuple[PacketRule, ...]) -> None:
        """Put the rules into force. Raises `BackendMissingError`, `FirewallError`; the old rules then stay in force."""

    def remove(self) -> None: ...

    def counters(self) -> tuple[RuleCounter, ...]:
        """Return rules that are in force and hooked in."""
