"""The firewall of the appliance's namespace: chooses a back end that works, installs the rules, says how
they stand.

Order of use: `install` before ROSMaster starts, `update` when a port becomes known or a host is enrolled,
`remove` when the appliance stops. Installing replaces whatever an earlier life left, of either back end.
"""

from dataclasses import dataclass
from typing import Literal

from appliance.channel.answers.status import FirewallRule
from appliance.network.firewall.backend import Backend, FirewallError, RuleCounter
from appliance.network.firewall.backend_check import prove
from appliance.network.firewall.firewall_rules import Family, FirewallSettings, Rule, appliance_rules
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.namespaces import Namespace, require_network_admin

BackendChoice = Literal["auto", "nft", "iptables"]


@dataclass(frozen=True)
class FirewallReport:
    """How the firewall stands."""

    backend: str | None  # None: not installed
    rules: tuple[FirewallRule, ...]
    not_used: tuple[str, ...]  # why a back end that was tried was not taken

    @property
    def intact(self) -> bool:
        """Every rule is in the kernel."""
        return self.backend is not None and all(rule.in_force for rule in self.rules)


class Firewall:
    """The rules of one namespace, by a given back end or the first proven to work (nft, then iptables)."""

    def __init__(self, namespace: Namespace, backend: BackendChoice = "auto") -> None:
        self._namespace = namespace
        self._choice = backend
        self._backend: Backend | None = None
        self._rules: tuple[Rule, ...] = ()
        self._not_used: list[str] = []

    def install(self, settings: FirewallSettings) -> str:
        """Choose a back end, clear what an earlier life left, install the rules; return the back end's name.

        Raises: PrivilegeError; FirewallError when no back end works, with the reason of each.
        """
        require_network_admin("the firewall")
        if self._backend is None:
            rules = appliance_rules(settings)
            self._backend, self._rules = self._choose(rules), rules
        else:
            self.update(settings)
        return self._backend.name

    def update(self, settings: FirewallSettings) -> None:
        """Replace the rules by those of new settings; if that fails, the old ones stay in force.

        Raises: FirewallError, also when `install` was not called before.
        """
        if self._backend is None:
            raise FirewallError("the firewall is not installed yet: call install first")
        rules = appliance_rules(settings)
        self._backend.install(rules)
        self._rules = rules

    def remove(self) -> None:
        """Take every rule of the appliance away, of either back end; none there is fine."""
        for backend in self._all():
            if self._backend is not None and backend.name == self._backend.name:
                backend.remove()
            else:
                self._clear(backend)
        self._backend, self._rules = None, ()

    def report(self) -> FirewallReport:
        """Say which rules are in force, with their counters."""
        backend, not_used = self._backend, tuple(self._not_used)
        if backend is None:
            return FirewallReport(None, statuses(self._rules, ()), not_used)
        rules = statuses(self._rules, backend.counters(), backend.families)
        return FirewallReport(backend.name, rules, not_used)

    def _all(self) -> tuple[Backend, ...]:
        return (NftBackend(self._namespace), IptablesBackend(self._namespace))

    def _choose(self, rules: tuple[Rule, ...]) -> Backend:
        """Return the first candidate that is proven to work and takes all the rules, which are then installed."""
        backends = self._all()
        for backend in backends:
            self._clear(backend)  # first, for a rule of either that is left over would spoil the proof
        self._not_used = []
        for backend in backends:
            if self._choice in ("auto", backend.name):
                try:
                    prove(backend, self._namespace)
                    backend.install(rules)
                except FirewallError as error:
                    self._not_used.append(f"{backend.name}: {error}")
                    self._clear(backend)
                else:
                    return backend
        raise FirewallError(
            f"no firewall can be had in {self._namespace.name}: {'; '.join(self._not_used)}. "
            "Give the container CAP_NET_ADMIN (iptables: CAP_NET_RAW too), or choose `isolation: none`"
        )

    def _clear(self, backend: Backend) -> None:
        """Take away what an earlier life left with a back end. One that cannot be used here left nothing."""
        try:
            backend.remove()
        except FirewallError as error:
            reason = f"{backend.name}: {error}"
            if reason not in self._not_used:
                self._not_used.append(reason)


def statuses(
    rules: tuple[Rule, ...], counters: tuple[RuleCounter, ...], families: tuple[Family, ...] = (4, 6)
) -> tuple[FirewallRule, ...]:
    """Join the rules with what the kernel says of them; the counts of both families are added up.

    A rule is in force when the kernel has it at least once for each family it is for (or once for both), of those
    that the kernel has at all (`families`).
    """
    of_rule: dict[tuple[str, str], list[RuleCounter]] = {}
    for counter in counters:
        of_rule.setdefault((counter.chain, counter.purpose), []).append(counter)
    found = []
    for rule in rules:
        chain, purpose = rule.chain.value, rule.purpose
        seen = of_rule.get((chain, purpose), ())
        packets, octets = sum(counter.packets for counter in seen), sum(counter.octets for counter in seen)
        present = sum(2 if counter.family is None else 1 for counter in seen)
        in_force = present >= len({*rule.families()} & {*families})
        found.append(FirewallRule(chain, purpose, rule.describe(), packets, octets, in_force))
    return tuple(found)
