"""The hosts of the site: which are blocked, and which are enrolled with a tunnel."""

from dataclasses import dataclass, field

from appliance.control.assembly.current import Provided
from appliance.control.assembly.host_authority import HostAuthority
from appliance.control.assembly.host_blocks import BlockTable
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.hosts.tunnel_state import Tunnels


@dataclass(frozen=True, slots=True)
class SiteHosts:
    """The tables of hosts. `provide(hosts)` offers their enrolment; without it, no host can be enrolled."""

    blocks: BlockTable
    table: HostTable
    tunnels: Tunnels
    authority: HostAuthority
    _enrolment: Provided[TunnelHosts] = field(default_factory=Provided)
    _nobody: TunnelHosts = field(default_factory=TunnelHosts)

    def provide(self, enrolment: TunnelHosts) -> None:
        self._enrolment.provide(enrolment)

    @property
    def enrolment(self) -> TunnelHosts:
        return self._enrolment() or self._nobody

    def names(self) -> dict[str, str]:
        """Return the addresses of enrolled hosts by their names."""
        return {row.name: row.address for row in self.table.enrolled()}
