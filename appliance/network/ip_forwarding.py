"""The host's forwarding settings: turned on, and put back as they were.

The kernel copies the global setting to every interface when it is written, so each interface's own value
is recorded too. A host that learns its IPv6 routes from router advertisements would stop listening to
them once it forwards; `accept_ra` 2 keeps it listening.
"""

from collections.abc import Sequence
from pathlib import Path

from appliance.network import interfaces
from appliance.network.firewall.firewall_rules import Family
from appliance.network.namespaces import Namespace

_GLOBAL: dict[Family, str] = {4: "net/ipv4/ip_forward", 6: "net/ipv6/conf/all/forwarding"}


class Forwarding:
    """The settings of one host."""

    def __init__(self, host: Namespace) -> None:
        self._host = host

    def has_ipv6(self) -> bool:
        """Tell whether the host uses IPv6 at all."""
        if not self._host.run(Path("/proc/sys/net/ipv6").exists):
            return False
        return self._host.sysctl("net/ipv6/conf/all/disable_ipv6") == "0"

    def before(self, family: Family) -> bool:
        """Tell whether the host forwards now."""
        return self._host.sysctl(_GLOBAL[family]) != "0"

    def record(self) -> dict[str, str]:
        """Return the settings that `enable` may change, in the order in which they are to be put back."""
        families: tuple[Family, ...] = (4, 6) if self.has_ipv6() else (4,)
        keys = [_GLOBAL[family] for family in families]
        for name in (*interfaces.links(self._host), "default"):
            keys += [f"net/ipv{family}/conf/{name}/forwarding" for family in families]
            keys += [f"net/ipv6/conf/{name}/accept_ra" for family in families if family == 6]
        return {key: self._host.sysctl(key) for key in keys}

    def enable(self, families: Sequence[Family]) -> None:
        """Forward from now on."""
        if 6 in families and not self.before(6):
            for name in interfaces.links(self._host):
                key = f"net/ipv6/conf/{name}/accept_ra"
                if self._host.sysctl(key) == "1":
                    self._host.sysctl(key, "2")
        for family in families:
            if not self.before(family):
                self._host.sysctl(_GLOBAL[family], "1")

    def restore(self, record: dict[str, str]) -> None:
        """Put back what `record` returned, where it differs; an interface that has gone is passed over."""
        for key, value in record.items():
            if self._host.run((Path("/proc/sys") / key).exists) and self._host.sysctl(key) != value:
                self._host.sysctl(key, value)
