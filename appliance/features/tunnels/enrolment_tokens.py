"""Keep the one-time tokens with which hosts enrol themselves. A host with an unused token is *awaited*.

1. Only the hash of a token's secret is stored.
2. A token is valid once, for one name, until it expires or a newer token for the name replaces it.
"""

from appliance.base import clock
from appliance.signing.bearer_secrets import SecretForm, hash_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.host_tables import EnrolmentTokenRow, HostTables

_FORM = SecretForm("rosrv-enrol_")
MAX = 1000
ENROLMENT = EndKind("enrolment", dated=True)


class BadEnrolmentTokenError(Exception):
    """The token is invalid; the message does not reveal why."""


class EnrolmentTokens:
    """All tokens that have not expired."""

    def __init__(self, tables: HostTables, ends: EndTable) -> None:
        self._tables = tables
        self._ends = ends
        self._rows = {row.name: row for row in tables.awaited()}
        ends.when_due(ENROLMENT, self._due)

    def rows(self) -> dict[str, EnrolmentTokenRow]:
        """Return the tokens by the names of their hosts, with their ends by the present system clock."""
        self._due([name for name in self._rows if self._ends.passed(ENROLMENT, name)])
        return {
            name: row._replace(expires=self._ends.date(ENROLMENT, name) or row.expires)
            for name, row in self._rows.items()
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

    def take(self, text: str) -> EnrolmentTokenRow:
        row = _FORM.find(text, {row.id: row for row in self.rows().values()})
        if row is None:
            raise BadEnrolmentTokenError(
                "the token is wrong, already used, or expired: ask for another one (rosrv host add NAME --token)"
            )
        self._take_out(row.name)  # its end stays, for `give_back`
        return row

    def give_back(self, row: EnrolmentTokenRow) -> None:
        """Make a token valid again, unless its name has a newer one, because no certificate was issued."""
        if row.name not in self._rows:
            self._rows[row.name] = row
            self._tables.save_awaited(row)

    def forget(self, name: str) -> None:
        self._due([name])

    def _take_out(self, name: str) -> None:
        if self._rows.pop(name, None) is not None:
            self._tables.forget_awaited(name)

    def _due(self, ended: list[str]) -> None:
        for name in ended:
            self._take_out(name)
        self._ends.forget(ENROLMENT, *ended)
