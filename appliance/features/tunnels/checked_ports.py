"""Keep the results of port checks from other machines."""

import ipaddress
from collections.abc import Callable

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels.certification import Certification
from appliance.features.tunnels.host_view import HostView
from appliance.features.tunnels.tunnel_answers import PortsReport
from appliance.hosts.host_table import HostRefusedError
from appliance.policy.host_names import HostInWords
from appliance.store.host_tables import PortsRow

_CLOCKS_DIFFER = 86_400.0
_MOST_PORTS = 100


class PortChecks:
    """The results by machine; `machines()` returns the number of nodes by address."""

    def __init__(
        self,
        certification: Certification,
        view: HostView,
        machines: Callable[[], dict[str, int]],
        in_words: HostInWords,
    ) -> None:
        self._certification = certification
        self._table = certification.table
        self._tunnels = certification.tunnels
        self._trail = certification.trail
        self._view = view
        self._machines = machines
        self._in_words = in_words

    async def tell(self, request: host_requests.HostPorts, who: str) -> PortsReport:
        self._table.require(request.expected)
        key, state = self._known_machine(request.name), request.state
        now = clock.wall()
        checked = now if request.checked is None else request.checked
        if checked > now + _CLOCKS_DIFFER:
            raise HostRefusedError(
                "the time of the check is more than a day in the future: correct the clock of the host, or of the"
                " appliance"
            )
        row = PortsRow(key, state, sorted(set(request.open))[:_MOST_PORTS], min(checked, now), who)
        self._table.keep_ports(row)
        self._trail.happened(
            "ports checked",
            f"the ROS ports of {self._in_words(key)} are {state}" + (f": {row.open}" if row.open else ""),
            severity=Severity.WARNING if state == "open" else Severity.NOTICE,
            name=key,
            state=state,
            open=row.open,
            checked=row.checked,
            who=who,
        )
        await self._certification.store.settled()
        return PortsReport(self._view.ports(key), self._table.revision, key)

    def in_clear_text(self) -> dict[str, int]:
        pool = self._table.pool
        return {
            address: nodes
            for address, nodes in self._machines().items()
            if not (one := ipaddress.ip_address(address)).is_loopback and one not in pool
        }

    def _known_machine(self, name: str) -> str:
        if name in self._table.rows or name in self._table.declared.hosts:
            return name
        try:
            address = str(ipaddress.ip_address(name))
        except ValueError:
            self._table.enrolled_row(name)  # raises an error that lists the enrolled hosts
            raise
        behind = [tunnel.name for tunnel in self._tunnels.seen.values() if tunnel.remote == address]
        row = self._table.at(address)
        return row.name if row is not None else behind[0] if len(behind) == 1 else address
