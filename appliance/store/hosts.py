"""The tables of hosts that come through tunnels: who is enrolled, with which certificate, who is awaited."""

import json
from dataclasses import dataclass

from appliance.store.database import Database

SCHEMA = """
CREATE TABLE IF NOT EXISTS host (
    name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE, serial TEXT NOT NULL, expires REAL NOT NULL,
    enrolled REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS host_certificate (
    name TEXT PRIMARY KEY, made REAL NOT NULL, certificate TEXT NOT NULL,
    next_serial TEXT, next_expires REAL, next_certificate TEXT
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS host_ports (
    name TEXT PRIMARY KEY, state TEXT NOT NULL, open TEXT NOT NULL, checked REAL NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS enrolment_token (
    name TEXT PRIMARY KEY, id TEXT NOT NULL, hash BLOB NOT NULL, created REAL NOT NULL, expires REAL NOT NULL,
    address TEXT NOT NULL, days REAL NOT NULL, kit TEXT NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS revoked_certificate (serial TEXT PRIMARY KEY, moment REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS revocation (
    serial TEXT PRIMARY KEY, name TEXT NOT NULL, moment REAL NOT NULL, expires REAL NOT NULL
) WITHOUT ROWID;
"""
_LONGEST_SECONDS = 398 * 86_400.0  # of a certificate's life, as the authority has it


@dataclass(frozen=True, slots=True)
class HostRow:
    """An enrolled host: its virtual address, its certificate's serial number (hexadecimal) and end.

    Times are seconds since the epoch; `revoked` is None while it may come. The address stays its name's.
    """

    name: str
    address: str
    serial: str
    expires: float
    enrolled: float
    revoked: float | None


@dataclass(frozen=True, slots=True)
class NextCertificate:
    """A certificate that its host has been given and has not said to have put in place."""

    serial: str
    expires: float
    certificate: str


@dataclass(frozen=True, slots=True)
class CertificateRow:
    """The certificate (PEM) of a host, when it was made, and the one that is to follow it."""

    name: str
    made: float
    certificate: str
    next: NextCertificate | None = None


@dataclass(frozen=True, slots=True)
class PortsRow:
    """What was seen of a machine's ROS ports from outside; `name` is a host's, or an address."""

    name: str
    state: str
    open: list[int]
    checked: float
    who: str


@dataclass(frozen=True, slots=True)
class AwaitedRow:
    """A host that is awaited with a one-time token, of which only the hash is kept. One for each name."""

    name: str
    id: str
    hash: bytes
    created: float
    expires: float
    address: str
    days: float
    kit: dict[str, str]
    who: str


@dataclass(frozen=True, slots=True)
class RevokedRow:
    """A certificate that is no longer its host's: since when, and its own end. `name` is empty if not known."""

    serial: str
    name: str
    moment: float
    expires: float


class HostTables:
    """Reads and writes them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def save(self, row: HostRow) -> None:
        """Keep a host, its new certificate, or that it is revoked."""
        self._database.submit(
            "INSERT OR REPLACE INTO host VALUES (?, ?, ?, ?, ?, ?)",
            (row.name, row.address, row.serial, row.expires, row.enrolled, row.revoked),
        )

    def hosts(self) -> list[HostRow]:
        """All hosts that were ever enrolled, by name."""
        return [HostRow(*row) for row in self._database.query("SELECT * FROM host ORDER BY name")]

    def save_certificate(self, row: CertificateRow) -> None:
        """Keep the certificate of a host."""
        following = row.next
        self._database.submit(
            "INSERT OR REPLACE INTO host_certificate VALUES (?, ?, ?, ?, ?, ?)",
            (
                row.name, row.made, row.certificate,
                following.serial if following else None,
                following.expires if following else None,
                following.certificate if following else None,
            ),
        )  # fmt: skip

    def certificates(self) -> list[CertificateRow]:
        """The certificates of all hosts."""
        return [
            CertificateRow(
                name,
                made,
                certificate,
                NextCertificate(serial, expires, text) if serial is not None else None,
            )
            for name, made, certificate, serial, expires, text in self._database.query(
                "SELECT * FROM host_certificate"
            )
        ]

    def save_ports(self, row: PortsRow) -> None:
        """Keep what was seen of a machine's ports."""
        self._database.submit(
            "INSERT OR REPLACE INTO host_ports VALUES (?, ?, ?, ?, ?)",
            (row.name, row.state, json.dumps(row.open), row.checked, row.who),
        )

    def ports(self) -> list[PortsRow]:
        """Everything that was seen of ports."""
        return [
            PortsRow(name, state, json.loads(opened), checked, who)
            for name, state, opened, checked, who in self._database.query("SELECT * FROM host_ports")
        ]

    def save_awaited(self, row: AwaitedRow) -> None:
        """Keep a one-time token, in the place of an earlier one of its name."""
        self._database.submit(
            "INSERT OR REPLACE INTO enrolment_token VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                row.name, row.id, row.hash, row.created, row.expires, row.address, row.days,
                json.dumps(row.kit), row.who,
            ),
        )  # fmt: skip

    def forget_awaited(self, name: str) -> None:
        """A token was used, or has ended."""
        self._database.submit("DELETE FROM enrolment_token WHERE name = ?", (name,))

    def awaited(self) -> list[AwaitedRow]:
        """The tokens that were not used."""
        return [
            AwaitedRow(name, token, digest, created, expires, address, days, json.loads(kit), who)
            for name, token, digest, created, expires, address, days, kit, who in self._database.query(
                "SELECT * FROM enrolment_token"
            )
        ]

    def save_revoked(self, row: RevokedRow) -> None:
        """Keep that a certificate is revoked."""
        self._database.submit(
            "INSERT OR IGNORE INTO revocation VALUES (?, ?, ?, ?)",
            (row.serial, row.name, row.moment, row.expires),
        )

    def forget_revoked(self, before: float) -> None:
        """Certificates that ended before this moment are good for nothing, revoked or not."""
        self._database.submit("DELETE FROM revocation WHERE expires < ?", (before,))
        self._database.submit(
            "DELETE FROM revoked_certificate WHERE moment < ?", (before - _LONGEST_SECONDS,)
        )

    def revoked(self) -> list[RevokedRow]:
        """All revoked certificates, the first one first."""
        # Before there was `revocation`, the end was not kept: it came within the longest life there is.
        rows = self._database.query(
            "SELECT serial, name, moment, expires FROM revocation UNION ALL"
            " SELECT serial, '', moment, moment + ? FROM revoked_certificate"
            " WHERE serial NOT IN (SELECT serial FROM revocation) ORDER BY moment",
            (_LONGEST_SECONDS,),
        )
        return [RevokedRow(*row) for row in rows]
