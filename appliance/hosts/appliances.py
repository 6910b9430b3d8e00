"""The appliances at which hosts open their tunnels. Without a pair, this appliance is the only one."""

from collections.abc import Iterable, Set

from appliance.base import clock
from appliance.channel.messages import CertificateMade
from appliance.store.host_tables import ApplianceRow, HostTables, RevokedCertificateRow

# Keep revoked certificates until long after their end, and select those for the revocation list (CRL).
#
# 1. A revoked certificate stays on the list until a day after its expiry. It is deleted more than a year later, by a
#    clock that has shown this for a day of running, so it stays revoked even if the clock was years ahead for a
#    while.
# 2. charon and swanctl reject a list that does not fit into one value of vici (65,535 bytes in DER). If it would not,
#    certificates of hosts that are not enrolled are left out: charon has no connection that matches them. Before
#    certificates of enrolled hosts exceed the limit, `require_room` rejects more replacements.

AFTER_END_SECONDS = 86_400.0  # tolerated difference between clocks
_KEPT_SECONDS = 400 * 86_400.0  # after a certificate's end
_STANDS_SECONDS = 86_400.0
ENTRIES_BYTES = 64_000  # of 65,535: names, extensions and the signature take less than 1,000
_ENTRY_BYTES = 21  # of an entry, without its serial number
_AT_ONCE_BYTES = 2 * (_ENTRY_BYTES + 20)  # two entries: a certificate and its stored successor


class RevokedCertificates:
    """The revoked certificates; `enrolled` are the names whose certificates charon accepts."""

    def __init__(self, kept: HostTables) -> None:
        self._kept = kept
        self._rows = {row.serial: row for row in kept.revoked_certificates()}
        self._ended: dict[str, float] = {}  # since when the clock shows that they ended long ago (monotonic)
        self.forget_ended()

    def add(self, name: str, serial: str, expires: float) -> None:
        row = RevokedCertificateRow(serial, name, clock.wall(), expires)
        if serial not in self._rows:
            self._rows[serial] = row
            self._kept.save_revoked(row)

    def forget_ended(self) -> None:
        """Delete certificates that even a wrong clock would not accept."""
        now, before = clock.now(), clock.wall() - _KEPT_SECONDS
        self._ended = {
            row.serial: self._ended.get(row.serial, now)
            for row in self._rows.values()
            if row.expires < before
        }
        for serial, since in list(self._ended.items()):
            if now - since >= _STANDS_SECONDS:
                del self._rows[serial], self._ended[serial]
                self._kept.forget_revoked(serial)

    def rows_to_send(self, enrolled: Set[str]) -> list[RevokedCertificateRow]:
        rows = self._not_ended()
        if _bytes_of(rows) > ENTRIES_BYTES:
            rows = [row for row in rows if _matters(row, enrolled)]
        kept, left = [], ENTRIES_BYTES
        for row in sorted(rows, key=lambda row: row.moment, reverse=True):
            left -= _bytes_of([row])
            if left < 0:
                break
            kept.append(row)
        return kept

    def missing(self, enrolled: Set[str]) -> int:
        rows = self._not_ended()
        if _bytes_of(rows) <= ENTRIES_BYTES:
            return 0
        on_it = {row.serial for row in self.rows_to_send(enrolled)}
        return sum(_matters(row, enrolled) and row.serial not in on_it for row in rows)

    def wait_for_room(self, enrolled: Set[str]) -> float:
        """Return 0 if there is room, otherwise the time when there will be (seconds since the epoch)."""
        rows = [row for row in self._not_ended() if _matters(row, enrolled)]
        if _bytes_of(rows) + _AT_ONCE_BYTES <= ENTRIES_BYTES:
            return 0.0
        return min(row.expires for row in rows) + AFTER_END_SECONDS

    def _not_ended(self) -> list[RevokedCertificateRow]:
        before = clock.wall() - AFTER_END_SECONDS
        return [row for row in self._rows.values() if row.expires >= before]


def _matters(row: RevokedCertificateRow, enrolled: Set[str]) -> bool:
    return not row.name or row.name in enrolled


def _bytes_of(rows: Iterable[RevokedCertificateRow]) -> int:
    return sum(_ENTRY_BYTES + int(row.serial, 16).bit_length() // 8 + 1 for row in rows)


CERTIFICATE_DAYS = 90.0


class Appliances:
    """The appliances; with a pair (`paired`), also the `other` one."""

    paired = False

    def __init__(self, kept: HostTables, revoked: RevokedCertificates) -> None:
        """Remove and revoke the appliances in the state, because this one is single now."""
        for row in kept.appliances():
            revoked.add("", row.serial, row.expires)
            kept.forget_appliance(row.key)

    @property
    def other(self) -> ApplianceRow | None:
        return None

    async def until_introduced(self) -> None:
        """Wait a moment for the other appliance of a pair."""

    def certificate(self, key: str) -> bytes:
        del key
        return b""

    def is_served(self, pin: str) -> None:
        """Note the pin of this appliance's REST server."""

    def note_own(self, key: str) -> None: ...

    def certified(self, key: str, made: CertificateMade) -> None: ...
