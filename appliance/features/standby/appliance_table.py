"""The two appliances at which hosts open their tunnels, with the certificates for their own tunnel keys.

Each key stays on its appliance. The standby's certificate is in the replicated state, for a takeover; the
certificate of a replaced appliance is revoked.
"""

import asyncio
import contextlib

import structlog

from appliance.base import clock
from appliance.channel.messages import APPLIANCE_NAME, CertificateMade
from appliance.features.standby.replication_frames import Introduction
from appliance.hosts.appliances import CERTIFICATE_DAYS, Appliances
from appliance.hosts.certificate_requests import AuthorityError, StoredAuthority
from appliance.hosts.revoked_certificates import RevokedCertificates
from appliance.store.host_tables import ApplianceRow, HostTables

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
