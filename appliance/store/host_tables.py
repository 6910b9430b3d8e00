"""The tables of hosts that come through tunnels: who is enrolled, with which certificate, who is awaited."""

import json
from typing import NamedTuple

from appliance.store.writer_thread import Database

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


class HostRow(NamedTuple):
    """An enrolled host: its virtual address, its certificate's serial number (hexadecimal) and end.

    Times are seconds since the epoch; `revoked` is None while it may come. The address stays its name's.
    """

    name: str
    address: str
    serial: str
    expires: float
    enrolled: float
    revoked: float | None


class NextCertificate(NamedTuple):
    """A certificate that its host has been given and has not said to have put in place."""

    serial: str
    expires: float
    certificate: str


class CertificateRow(NamedTuple):
    """The certificate (PEM) of a host, when it was made, and the one that is to follow it."""

    name: str
    made: float
    certificate: str
    next: NextCertificate | None = None


class PortsRow(NamedTuple):
    """What was seen of a machine's ROS ports from outside; `name` is a host's, or an address."""

    name: str
    state: str
    open: list[int]
    checked: float
    who: str


class AwaitedRow(NamedTuple):
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


class RevokedRow(NamedTuple):
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
        self._database.put("host", *row)

    def hosts(self) -> list[HostRow]:
        """All hosts that were ever enrolled, by name."""
        return [HostRow(*row) for row in self._database.query("SELECT * FROM host ORDER BY name")]

    def save_certificate(self, row: CertificateRow) -> None:
        """Keep the certificate of a host."""
        self._database.put("host_certificate", *row[:-1], *(row.next or (None, None, None)))

    def certificates(self) -> list[CertificateRow]:
        """The certificates of all hosts."""
        return [
            CertificateRow(
                name, made, certificate, NextCertificate(*following) if following[0] is not None else None
            )
            for name, made, certificate, *following in self._database.query("SELECT * FROM host_certificate")
        ]

    def save_ports(self, row: PortsRow) -> None:
        """Keep what was seen of a machine's ports."""
        self._database.put("host_ports", row.name, row.state, json.dumps(row.open), row.checked, row.who)

    def ports(self) -> list[PortsRow]:
        """Everything that was seen of ports."""
        rows = self._database.query("SELECT * FROM host_ports")
        return [PortsRow(name, state, json.loads(opened), *told) for name, state, opened, *told in rows]

    def save_awaited(self, row: AwaitedRow) -> None:
        """Keep a one-time token, in the place of an earlier one of its name."""
        self._database.put("enrolment_token", *row[:-2], json.dumps(row.kit), row.who)

    def forget_awaited(self, name: str) -> None:
        """A token was used, or has ended."""
        self._database.delete("enrolment_token", name=name)

    def awaited(self) -> list[AwaitedRow]:
        """The tokens that were not used."""
        rows = self._database.query("SELECT * FROM enrolment_token")
        return [AwaitedRow._make((*row[:-2], json.loads(row[-2]), row[-1])) for row in rows]

    def save_revoked(self, row: RevokedRow) -> None:
        """Keep that a certificate is revoked."""
        self._database.submit("INSERT OR IGNORE INTO revocation VALUES (?, ?, ?, ?)", row)

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
