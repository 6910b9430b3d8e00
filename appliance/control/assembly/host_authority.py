"""Make the table of hosts, the authority of their certificates, and the table of the appliances of their tunnels."""

from functools import partial
from typing import NamedTuple

from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.hosts.appliances import Appliances
from appliance.hosts.certificate_requests import Authority, StoredAuthority
from appliance.hosts.host_table import HostTable
from appliance.hosts.hosts_file import BUNDLED_HOSTS, DECLARED_HOSTS, DeclaredHosts
from appliance.signing.fingerprints import fingerprint
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail


class HostAuthority(NamedTuple):
    """The authority, and the appliances that it certifies."""

    authority: StoredAuthority
    appliances: Appliances


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
