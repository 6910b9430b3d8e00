"""The certificates that are no longer their hosts': kept until long after their end, and chosen for the list (CRL).

Invariants:

1. A revoked certificate is on the list until a day after its own end. It is forgotten a good year later: a clock that
   stood too late for a while, and is set back, lets none in again.
2. The list fits into one value of vici (65,535 bytes, DER): a longer one, charon and swanctl do not take. Where that is
   too little, certificates of names that are not enrolled are left out, for which charon has no configuration that
   could match; and `require_room` refuses to replace certificates before the others need more.
"""

import time
from collections.abc import Iterable, Set

from appliance.store.host_tables import HostTables, RevokedRow

AFTER_END_SECONDS = 86_400.0  # that clocks may differ by
_KEPT_SECONDS = 400 * 86_400.0  # after the end
ENTRIES_BYTES = 64_000  # of 65,535: names, extensions and the signature take less than 1,000
_ENTRY_BYTES = 21  # besides the serial number
_AT_ONCE_BYTES = 2 * (_ENTRY_BYTES + 20)  # a certificate, and the one that was to follow it


class RevokedCertificates:
    """All of them that count; `enrolled` are the names whose certificates charon takes."""

    def __init__(self, kept: HostTables) -> None:
        self._kept = kept
        self._rows = {row.serial: row for row in kept.revoked()}
        self.forget_ended()

    def add(self, name: str, serial: str, expires: float) -> None:
        """A certificate is its host's no more."""
        row = RevokedRow(serial, name, time.time(), expires)
        if serial not in self._rows:
            self._rows[serial] = row
            self._kept.save_revoked(row)

    def forget_ended(self) -> None:
        """Those that nobody could use any more, whatever time it is, are not kept."""
        before = time.time() - _KEPT_SECONDS
        ended = [row.serial for row in self._rows.values() if row.expires < before]
        for serial in ended:
            del self._rows[serial]
        if ended:
            self._kept.forget_revoked(before)

    def listed(self, enrolled: Set[str]) -> list[RevokedRow]:
        """What is on the list, the latest first."""
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
        """How many of enrolled names should be on the list and are not."""
        rows = self._not_ended()
        if _bytes_of(rows) <= ENTRIES_BYTES:
            return 0
        on_it = {row.serial for row in self.listed(enrolled)}
        return sum(_matters(row, enrolled) and row.serial not in on_it for row in rows)

    def wait_for_room(self, enrolled: Set[str]) -> float:
        """0 when another certificate of these names can be replaced, else when the next one leaves the list (epoch)."""
        rows = [row for row in self._not_ended() if _matters(row, enrolled)]
        if _bytes_of(rows) + _AT_ONCE_BYTES <= ENTRIES_BYTES:
            return 0.0
        return min(row.expires for row in rows) + AFTER_END_SECONDS

    def _not_ended(self) -> list[RevokedRow]:
        before = time.time() - AFTER_END_SECONDS
        return [row for row in self._rows.values() if row.expires >= before]


def _matters(row: RevokedRow, enrolled: Set[str]) -> bool:
    return not row.name or row.name in enrolled


def _bytes_of(rows: Iterable[RevokedRow]) -> int:
    return sum(_ENTRY_BYTES + int(row.serial, 16).bit_length() // 8 + 1 for row in rows)
