"""Connect control to the replication, the tunnels and the lease of a pair, while this appliance is active."""

from collections.abc import Awaitable, Callable

from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.host_authority import HostAuthority
from appliance.features.standby.appliance_table import ApplianceTable
from appliance.features.standby.replication import Pair, Replication, host_endpoint
from appliance.features.standby.shared_authority import SharedAuthority
from appliance.hosts.certificate_requests import Authority
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail


class PairedRole(ActiveRole):
    """The role of the active one of two appliances."""

    paired = True

    def __init__(self, pair: Pair, settings: Settings) -> None:
        self.pair = pair
        self._settings = settings
        self._replication: Replication | None = None
        self.name, self.address = pair.membership.name, pair.membership.fixed
        self.ports = pair.membership.port_ranges()
        self.robot = pair.membership.witness
        self.took_over, self.away_seconds = pair.taken_over, pair.away_seconds
        self.api, self.pin = pair.api, pair.tunnels.pin

    @property
    def replication(self) -> Replication:
        if self._replication is None:
            raise RuntimeError("the replication is used before the state is inherited")
        return self._replication

    @property
    def before_answer(self) -> Callable[[], Awaitable[None]]:
        return self.replication.stored

    def inherit(self, store: StateStore) -> None:
        pair, settings = self.pair, self._settings
        store.note_whole_parameters()
        self._replication = Replication(
            pair.membership,
            pair.lease,
            store.database,
            pair.epoch,
            taken_over=pair.taken_over,
            folder=settings.state / "control",
        )

    def host_authority(
        self, signer: Link, store: StateStore, trail: AuditTrail, table: HostTable
    ) -> HostAuthority:
        del trail
        authority = SharedAuthority(Authority(signer), store.hosts)
        endpoint = host_endpoint(self._settings, self.pair.membership)
        appliances = ApplianceTable(store.hosts, table.revoked, endpoint)
        self.replication.on_introduction(lambda other: appliances.introduce(other, authority))
        return HostAuthority(authority, appliances)

    def hand_tunnels_to(self, tunnels: Tunnels) -> None:
        self.pair.tunnels.hand_to(tunnels)

    def in_doubt(self) -> bool:
        return self.replication.admission.in_doubt()

    def on_end_of_gap(self, ended: Callable[[], None]) -> None:
        self.replication.admission.on_end_of_gap(ended)

    def close(self) -> None:
        self.replication.close()
