"""Connect control to the replication, the tunnels and the lease of a pair, while this appliance is active."""

import asyncio
import contextlib
import datetime
from collections.abc import Awaitable, Callable

import structlog

from appliance.base import clock
from appliance.channel.link import Link
from appliance.channel.messages import APPLIANCE_NAME, CertificateMade
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.hosts import HostAuthority
from appliance.features.standby.replication import Pair, Replication, host_endpoint
from appliance.features.standby.replication_frames import Introduction
from appliance.hosts.appliances import CERTIFICATE_DAYS, Appliances, RevokedCertificates
from appliance.hosts.certificate_requests import Authority, AuthorityError, StoredAuthority
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.store.host_tables import ApplianceRow, AuthorityRow, HostTables
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

# Use the hosts' certificate authority on an appliance that may lack its key, because the other one has it.
#
# Its certificate and its last signed list of revoked certificates are replicated, so tunnels open without the key.
# A revoked host is shut out anyway, because charon loads no connection for it.

LIST_DAYS = 30.0  # strongSwan accepts a list for so long (`certificate_authority.REVOCATIONS_DAYS`)
_WAITS = (
    "new certificates wait, because the key of the hosts' authority is on the other appliance: make that one active"
    " (rosrv standby switch), or set ipsec.ca_passphrase_file on both, run `rosrv standby join` again and restart"
    " this one"
)


class SharedAuthority(StoredAuthority):
    """The certificate authority of a pair. The signer of this appliance may lack its key."""

    def __init__(self, signer: Authority, kept: HostTables) -> None:
        super().__init__(signer, kept)
        self._obstacle = ""  # as last seen

    @property
    def waits(self) -> str:
        if not self._obstacle or self._row is None or not self._row.revocations:
            return self._obstacle
        end = datetime.datetime.fromtimestamp(self._row.signed + LIST_DAYS * 86_400, datetime.UTC)
        return (
            f"{self._obstacle}; tunnels open until {end:%Y-%m-%d %H:%M}Z, when the last signed list of revoked"
            " certificates ends"
        )

    def _keeps(self, kept: AuthorityRow, own: bytes) -> bool:
        del kept, own
        return True

    async def obstacle(self) -> str:
        stated, used = await self._signer.statement(), await self.certificate()
        trouble = f" ({stated.trouble})" if stated.trouble else ""
        self._obstacle = "" if stated.certificate == used else _WAITS + trouble
        return self._obstacle

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        """Return the signed list (PEM) of these serial numbers and times; without the key, the last signed list."""
        certificate = await self.certificate()
        if obstacle := await self.obstacle():
            if self._row is None or not self._row.revocations:
                raise AuthorityError(f"no list of revoked certificates was signed yet; {obstacle}")
            return self._row.revocations.encode()
        signed = await self._signer.revocations(revoked)
        self._save(AuthorityRow(certificate.decode(), signed.decode(), clock.wall()))
        return signed


# The two appliances at which hosts open their tunnels, with the certificates for their own tunnel keys.
#
# Each key stays on its appliance. The standby's certificate is in the replicated state, for a takeover; the
# certificate of a replaced appliance is revoked.

_RENEWED_DAYS = 60.0  # at least these days are left when the standby takes over
_INTRODUCTION_SECONDS = 8.0
_REPLACED_SECONDS = 3600.0  # each replaced key makes the list of revoked certificates longer

_log = structlog.get_logger()


class ApplianceTable(Appliances):
    """Both appliances; `endpoint` is the address at which hosts reach this one."""

    paired = True

    def __init__(self, kept: HostTables, revoked: RevokedCertificates, endpoint: str) -> None:
        self._kept = kept
        self._revoked = revoked
        self._endpoint = endpoint
        self._rows = {row.key: row for row in kept.appliances()}
        self._introducing = asyncio.Lock()
        self._introduced = asyncio.Event()
        self._replaceable = (
            -_REPLACED_SECONDS
        )  # when the other appliance was last replaced, by the monotonic clock
        self._own = ""  # the fingerprint of this appliance's tunnel key
        self._pin = ""

    @property
    def other(self) -> ApplianceRow | None:
        return next((row for row in self._rows.values() if not self._is_own(row)), None)

    async def until_introduced(self) -> None:
        if self.other is None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_INTRODUCTION_SECONDS):
                    await self._introduced.wait()

    def certificate(self, key: str) -> bytes:
        row = self._rows.get(key)
        return row.certificate.encode() if row is not None and row.expires > clock.wall() else b""

    def is_served(self, pin: str) -> None:
        self._pin = pin
        row = self._rows.get(self._own)
        if row is not None and pin not in ("", row.pin):
            self._save(row._replace(pin=pin))

    def note_own(self, key: str) -> None:
        self._own = key
        self.is_served(self._pin)

    def certified(self, key: str, made: CertificateMade) -> None:
        self._own = key
        self._save(_row(key, self._endpoint, self._pin, made))

    async def introduce(self, other: Introduction, authority: StoredAuthority) -> None:
        """Certify the other appliance's tunnel key if needed. In the meantime, its repeated introductions are
        ignored.
        """
        if self._introducing.locked():
            return
        async with self._introducing:
            if other.endpoint == self._endpoint:
                _log.warning("both appliances have the same address for hosts; set ipsec.endpoint on each")
                return
            row = self._rows.get(other.key)
            if row is None or row.expires < clock.wall() + _RENEWED_DAYS * 86_400:
                await self._certify(other, authority, row)
            elif (row.endpoint, row.pin) != (other.endpoint, other.pin):
                self._save(row._replace(endpoint=other.endpoint, pin=other.pin))
            self._introduced.set()

    async def _certify(
        self, other: Introduction, authority: StoredAuthority, before: ApplianceRow | None
    ) -> None:
        now = clock.now()
        if before is None and now < self._replaceable + _REPLACED_SECONDS:
            _log.warning("the other appliance changes its tunnel key too often; it gets no certificate yet")
            return
        try:
            made = await authority.issue(other.request, APPLIANCE_NAME, CERTIFICATE_DAYS)
        except AuthorityError as error:
            _log.warning("the other appliance gets no certificate for its tunnels", reason=str(error))
            return
        if before is None:
            self._replaceable = now
        self._save(_row(other.key, other.endpoint, other.pin, made))
        for row in list(self._rows.values()):
            if row.key != other.key and not self._is_own(row):
                self._forget(row)

    def _is_own(self, row: ApplianceRow) -> bool:
        return row.key == self._own or row.endpoint == self._endpoint

    def _save(self, row: ApplianceRow) -> None:
        self._rows[row.key] = row
        self._kept.save_appliance(row)

    def _forget(self, row: ApplianceRow) -> None:
        self._revoked.add("", row.serial, row.expires)
        del self._rows[row.key]
        self._kept.forget_appliance(row.key)


def _row(key: str, endpoint: str, pin: str, made: CertificateMade) -> ApplianceRow:
    return ApplianceRow(key, endpoint, pin, made.certificate.decode(), made.serial, made.expires)


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
        return self.replication.until_stored

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
