"""Check the Host header of requests, so that a page whose name an attacker points at the collector cannot use it."""

import ipaddress
from collections.abc import Iterable

WRONG_HOST = (
    "the collector does not answer to this host name: use its address, a name of its certificate, or add the name to"
    " `names` in fleet.yaml"
)


class CollectorNames:
    """The names of the collector: its addresses, `localhost`, those of its certificate, and `names`."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = {"localhost", *(name.rstrip(".").lower() for name in names)}

    def include(self, headers: list[str]) -> bool:
        """Return whether there is one Host header, and it names the collector."""
        name = _name_in(headers[0]) if len(headers) == 1 else ""
        return _is_address(name) or name in self._names or f"*.{name.partition('.')[2]}" in self._names


def _name_in(header: str) -> str:
    if header.startswith("["):
        name, bracket, rest = header[1:].partition("]")
        return name if bracket and (not rest or rest.startswith(":")) else ""
    return header.partition(":")[0].rstrip(".").lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
