"""Keep the one-time tokens with which hosts enrol themselves. A host with an unused token is *awaited*.

1. Only the hash of a token's secret is stored.
2. A token is valid once, for one name, until it expires or a newer token for the name replaces it.
3. A used token's row stays until its end, for a host to which the answer was lost: with the same signing request, it
   gets the same certificate. The row's hash is then of the secret and this request.
"""

from collections.abc import Mapping

from appliance.base import clock
from appliance.signing.bearer_secrets import SecretForm, hash_of, is_hash_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.host_tables import EnrolmentTokenRow, HostRow, HostTables

_FORM = SecretForm("rosrv-enrol_")
MAX = 1000
USED = "serial"
"""The key in `EnrolmentTokenRow.kit` that a used token has: with the serial number of its certificate."""
ENROLMENT = EndKind("enrolment", dated=True)


class BadEnrolmentTokenError(Exception):
    """The token is invalid; the message does not reveal why."""


class EnrolmentTokens:
    """All tokens that have not expired."""

    def __init__(self, tables: HostTables, ends: EndTable) -> None:
        self._tables = tables
        self._ends = ends
        self._rows = {row.name: row for row in tables.enrolment_tokens()}
        ends.when_due(ENROLMENT, self._due)

    def rows(self) -> dict[str, EnrolmentTokenRow]:
        """Return the unused tokens by the names of their hosts, with their ends by the present system clock."""
        self._due([name for name in self._rows if self._ends.is_over(ENROLMENT, name)])
        return {
            name: row._replace(expires=self._ends.date(ENROLMENT, name) or row.expires)
            for name, row in self._rows.items()
            if USED not in row.kit
        }

    def addresses(self) -> dict[str, str]:
        return {row.address: name for name, row in self.rows().items()}

    def add(
        self, name: str, *, seconds: float, address: str, days: float, kit: dict[str, str], who: str
    ) -> tuple[EnrolmentTokenRow, str]:
        (token_id, secret, text), now = _FORM.make(), clock.wall()
        row = EnrolmentTokenRow(name, token_id, hash_of(secret), now, now + seconds, address, days, kit, who)
        self._rows[name] = row
        with self._tables.together():  # an earlier token of the name must not get this end
            self._ends.set(ENROLMENT, name, seconds)
            self._tables.save_awaited(row)
        return row, text

    def find(self, text: str, request: str, hosts: Mapping[str, HostRow]) -> EnrolmentTokenRow:
        """Return the row of a token that is unused, or whose use with this request made the host's certificate.

        Raises `BadEnrolmentTokenError`.
        """
        self.rows()  # forgets those that have ended
        number, secret = _FORM.parse(text) or ("", "")
        row = next((row for row in self._rows.values() if row.id == number), None)
        serial = None if row is None else row.kit.get(USED)
        if serial is not None:
            secret = hash_of(secret).hex() + request
        if (
            row is None
            or not is_hash_of(secret, row.hash)
            or (serial is not None and serial != hosts[row.name].serial)
        ):
            raise BadEnrolmentTokenError(
                "the token is wrong, already used, or expired: ask for another one (rosrv host add NAME --token)"
            )
        return row

    def use(self, row: EnrolmentTokenRow, request: str, serial: str) -> None:
        """Let a token be valid only with this request, for which the certificate was issued."""
        if row is self._rows.get(row.name):  # otherwise it has ended
            used = row._replace(hash=hash_of(row.hash.hex() + request), kit=row.kit | {USED: serial})
            self._rows[row.name] = used
            self._tables.save_awaited(used)

    def forget(self, name: str) -> None:
        self._due([name])

    def _due(self, ended: list[str]) -> None:
        for name in ended:
            if self._rows.pop(name, None) is not None:
                self._tables.forget_awaited(name)
        self._ends.forget(ENROLMENT, *ended)
