"""The hosts that get no message of a topic while a monitor withholds it."""

from collections.abc import Callable
from ipaddress import ip_address, ip_network

_MOST_KNOWN = 1000


class HostMask:
    """Hides a topic from hosts in the networks that `networks()` returns, at each delivery."""

    def __init__(self, networks: Callable[[], tuple[str, ...]]) -> None:
        self._networks = networks
        self._known: dict[tuple[str, str], bool] = {}

    def hides(self, host: str) -> bool:
        """Return whether to hide the topic from this host; a host without an IP address counts as in every network."""
        return any(self._contains(network, host) for network in self._networks())

    def _contains(self, network: str, host: str) -> bool:
        found = self._known.get((network, host))
        if found is None:
            try:
                found = ip_address(host) in ip_network(network)
            except ValueError:
                found = True
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            self._known[network, host] = found
        return found
