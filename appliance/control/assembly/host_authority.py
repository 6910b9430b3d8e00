"""Make the authority of hosts' certificates, and the table of the appliances at which hosts open their tunnels."""

from typing import NamedTuple

from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.features.standby.appliance_table import ApplianceTable
from appliance.features.standby.replication import Pair, Replication, host_endpoint
from appliance.features.standby.shared_authority import SharedAuthority
from appliance.hosts.certificate_requests import Authority
from appliance.hosts.host_table import HostTable
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail


class HostAuthority(NamedTuple):
    """The authority, and the appliances that it certifies."""

    authority: SharedAuthority
    appliances: ApplianceTable


def make_host_authority(
    settings: Settings,
    signer: Link,
    store: StateStore,
    trail: AuditTrail,
    table: HostTable,
    *,
    pair: Pair | None,
    replication: Replication | None,
) -> HostAuthority:
    """Return the authority by this appliance's signer. On one of two appliances, the standby can introduce itself."""
    authority = SharedAuthority(
        Authority(signer), store.hosts, shared=pair is not None, replaced=lambda: _record_replaced(trail)
    )
    endpoint = host_endpoint(settings, pair.membership) if pair is not None else None
    appliances = ApplianceTable(store.hosts, table.revoked, endpoint)
    if replication is not None:
        replication.on_introduction(lambda other: appliances.introduce(other, authority))
    return HostAuthority(authority, appliances)


def _record_replaced(trail: AuditTrail) -> None:
    trail.happened(
        "host authority replaced",
        "the authority of hosts has another key: no certificate of the earlier one is accepted, and each enrolled host"
        " needs a new kit (rosrv host kit NAME)",
    )
