"""Run the firewall of the appliance's namespace with a back end that works."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from appliance.channel.answers.status import FirewallRule
from appliance.network.firewall.backend import Backend, FirewallError, RuleCounter
from appliance.network.firewall.backend_check import prove
from appliance.network.firewall.firewall_rules import Family, FirewallSettings, PacketRule, appliance_rules
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.namespaces import Namespace, require_network_admin

BackendChoice = Literal["auto", "nft", "iptables"]


@dataclass(frozen=True)
class FirewallReport:
    backend: str | None  # None: no rules are installed
    rules: tuple[FirewallRule, ...]
    not_used: tuple[str, ...]  # the reason for each back end that was not used

    @property
    def intact(self) -> bool:
        return self.backend is not None and all(rule.in_force for rule in self.rules)


class Firewall:
    """The firewall with the given back end, or with the first that works (nft, then iptables)."""

    def __init__(self, namespace: Namespace, backend: BackendChoice = "auto") -> None:
        self._namespace = namespace
        self._choice = backend
        self._backend: Backend | None = None
        self._rules: tuple[PacketRule, ...] = ()
        self._not_used: list[str] = []
        self._turn = threading.Lock()  # so that no rule is restored during a change, or after the removal

    def install(self, settings: FirewallSettings) -> str:
        """Install the rules, after removing those of an earlier run. Raises `PrivilegeError`, `FirewallError`."""
        require_network_admin("the firewall")
        rules = appliance_rules(settings)
        with self._turn:
            if self._backend is None:
                self._backend = self._choose(rules)
            else:
                self._backend.install(rules)
            self._rules = rules
            return self._backend.name

    def update(self, settings: FirewallSettings) -> None:
        """Replace the rules. Raises `FirewallError`; the old rules then stay in force."""
        rules = appliance_rules(settings)
        with self._turn:
            if self._backend is None:
                raise FirewallError("the firewall is not installed yet: call install first")
            self._backend.install(rules)
            self._rules = rules

    def restore(self) -> list[str]:
        """Install the rules again if the kernel lacks some; return the purposes of these. Raises `FirewallError`."""
        with self._turn:
            if self._backend is None:
                return []
            rules = statuses(self._rules, self._backend.counters(), self._backend.families)
            missing = [rule.purpose for rule in rules if not rule.in_force]
            if missing:
                with installing_again():
                    self._backend.install(self._rules)
            return missing

    def remove(self) -> None:
        with self._turn:
            for backend in self._all():
                if self._backend is not None and backend.name == self._backend.name:
                    backend.remove()
                else:
                    self._clear(backend)
            self._backend, self._rules = None, ()

    def report(self) -> FirewallReport:
        backend, not_used = self._backend, tuple(self._not_used)
        if backend is None:
            return FirewallReport(None, statuses(self._rules, ()), not_used)
        rules = statuses(self._rules, backend.counters(), backend.families)
        return FirewallReport(backend.name, rules, not_used)

    def _all(self) -> tuple[Backend, ...]:
        return (NftBackend(self._namespace), IptablesBackend(self._namespace))

    def _choose(self, rules: tuple[PacketRule, ...]) -> Backend:
        backends = self._all()
        for backend in backends:
            self._clear(backend)  # an old rule of any back end would disturb the test
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
            f"no firewall works in {self._namespace.name}: {'; '.join(self._not_used)}. "
            "Give the container CAP_NET_ADMIN (iptables: CAP_NET_RAW too), or choose `isolation: none`"
        )

    def _clear(self, backend: Backend) -> None:
        try:
            backend.remove()
        except FirewallError as error:
            reason = f"{backend.name}: {error}"
            if reason not in self._not_used:
                self._not_used.append(reason)


@contextlib.contextmanager
def installing_again() -> Iterator[None]:
    """Let a failure say more than one of listing the rules does."""
    try:
        yield
    except FirewallError as error:
        raise FirewallError(f"removed rules cannot be installed again: {error}") from error


def statuses(
    rules: tuple[PacketRule, ...], counters: tuple[RuleCounter, ...], families: tuple[Family, ...] = (4, 6)
) -> tuple[FirewallRule, ...]:
    """Return the state of each rule: it is in force if the kernel has it for each of `families`, or once for both."""
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
