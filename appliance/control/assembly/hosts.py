"""The hosts of the site: which are blocked, which have a tunnel, and the authority of their certificates."""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.assembly.services import Provided
from appliance.hosts.appliances import Appliances
from appliance.hosts.certificate_requests import Authority, StoredAuthority
from appliance.hosts.host_table import HostTable
from appliance.hosts.hosts_file import BUNDLED_HOSTS, DECLARED_HOSTS, DeclaredHosts
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.hosts.tunnel_state import Tunnels
from appliance.signing.fingerprints import fingerprint
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail


class HostAuthority(NamedTuple):
    """The authority, and the appliances that it certifies."""

    authority: StoredAuthority
    appliances: Appliances


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
        """Return the addresses in the tunnels of enrolled hosts, by their names."""
        rows = self.table.hosts()
        return {row.name: row.address for row in rows if self.table.is_for_hosts(row.address)}


def make_host_table(settings: Settings, store: StateStore) -> HostTable:
    kept = store.settings()
    declared = DeclaredHosts(settings.hosts, kept.get(BUNDLED_HOSTS, ""), kept.get(DECLARED_HOSTS, ""))
    return HostTable(store, settings.ipsec.pool, declared)


def make_host_authority(
    signer: Link, store: StateStore, trail: AuditTrail, table: HostTable
) -> HostAuthority:
    authority = StoredAuthority(Authority(signer), store.hosts, replaced=partial(_record_replaced, trail))
    return HostAuthority(authority, Appliances(store.hosts, table.revoked))


def _record_replaced(trail: AuditTrail, earlier: bytes, now: bytes) -> None:
    trail.happened(
        "host authority replaced",
        "the authority of hosts has another key: no certificate of the earlier one is accepted, and each enrolled host"
        " needs a new kit (rosrv host kit NAME)",
        sha256=fingerprint(now),
        earlier_sha256=fingerprint(earlier),
    )
