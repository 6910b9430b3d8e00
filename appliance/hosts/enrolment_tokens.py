"""Hosts that are awaited: one-time tokens by which a host enrols itself.

Invariants:

1. A token's text exists in one answer; only the hash of its secret is kept (256 random bits need no slow hash).
2. It is good once, until its end, for one name; a newer token of the name ends it. It is taken before a
   certificate is asked for, so two who bring it at once get one.
"""

import hashlib
import hmac
import re
import secrets
import time

from appliance.store.host_tables import AwaitedRow, HostTables

_FORM = re.compile(r"rosrv-enrol_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
LONGEST_SECONDS = 7 * 86_400.0
MOST = 1000


class BadEnrolmentTokenError(Exception):
    """The token opens nothing; the text says no more than that to whoever brought it."""


class Awaited:
    """All tokens that were not used; ended ones are forgotten."""

    def __init__(self, tables: HostTables) -> None:
        self._tables = tables
        self._rows = {row.name: row for row in tables.awaited()}

    def rows(self) -> dict[str, AwaitedRow]:
        """Those that can be used now, by the names of their hosts."""
        now = time.time()
        for name in [name for name, row in self._rows.items() if row.expires <= now]:
            self.forget(name)
        return dict(self._rows)

    def addresses(self) -> dict[str, str]:
        """The addresses that are promised, with the names of their hosts."""
        return {row.address: name for name, row in self.rows().items()}

    def add(
        self, name: str, *, seconds: float, address: str, days: float, kit: dict[str, str], who: str
    ) -> tuple[AwaitedRow, str]:
        """Make a token; its text is given here and never again."""
        token_id, now = secrets.token_hex(6), time.time()
        secret = secrets.token_urlsafe(32)
        row = AwaitedRow(name, token_id, _hash(secret), now, now + seconds, address, days, kit, who)
        self._rows[name] = row
        self._tables.save_awaited(row)
        return row, f"rosrv-enrol_{token_id}_{secret}"

    def take(self, text: str) -> AwaitedRow:
        """Use a token up. Raises `BadEnrolmentTokenError`."""
        found = _FORM.fullmatch(text)
        rows = {row.id: row for row in self.rows().values()}
        row = rows.get(found[1]) if found is not None else None
        if found is None or row is None or not hmac.compare_digest(_hash(found[2]), row.hash):
            raise BadEnrolmentTokenError(
                "the token is wrong, was used before, or has ended: ask for another one (rosrv host add NAME --token)"
            )
        self.forget(row.name)
        return row

    def give_back(self, row: AwaitedRow) -> None:
        """What it was taken for could not be done, for no fault of its bearer's: it is good again."""
        if row.name not in self._rows:
            self._rows[row.name] = row
            self._tables.save_awaited(row)

    def forget(self, name: str) -> None:
        """End the token of a name, if it has one."""
        if self._rows.pop(name, None) is not None:
            self._tables.forget_awaited(name)


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("ascii")).digest()
