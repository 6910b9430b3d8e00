"""What a back end of the firewall does: put rules into a namespace, take them away, count their packets."""

from dataclasses import dataclass
from typing import Protocol

from appliance.network.firewall.firewall_rules import Family, Rule
from appliance.network.namespaces import NetworkError


class FirewallError(NetworkError):
    """The kernel or its tools refused the rules, or do not enforce them."""


class BackendMissingError(FirewallError):
    """This machine cannot use the back end at all: a program, a library or a kernel part is not there."""


@dataclass(frozen=True)
class RuleCounter:
    """A rule as it stands in the kernel."""

    chain: str
    family: Family | None  # None: one rule for both
    purpose: str
    packets: int
    octets: int


class Backend(Protocol):
    """A way to program the kernel, for one namespace."""

    @property
    def name(self) -> str:
        """`nft` or `iptables`."""

    @property
    def families(self) -> tuple[Family, ...]:
        """The families that the rules are put in force for: those that the kernel has."""

    def install(self, rules: tuple[Rule, ...]) -> None:
        """Replace the appliance's rules by these, whatever was left there before; foreign rules stay as
        they are.

        Raises: BackendMissingError; FirewallError (the old rules are then still in force).
        """

    def remove(self) -> None:
        """Take every rule and chain of the appliance away; none there is fine."""

    def counters(self) -> tuple[RuleCounter, ...]:
        """Return the appliance's rules that are in force and hooked in; empty if there are none."""
