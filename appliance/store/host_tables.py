"""The tables of hosts: hosts that connect through tunnels, their certificates, awaited hosts, blocked hosts."""

import json
from contextlib import AbstractContextManager
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
CREATE TABLE IF NOT EXISTS host_block (
    address TEXT PRIMARY KEY, since REAL NOT NULL, ends INTEGER, who TEXT NOT NULL, note TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS authority (
    id INTEGER PRIMARY KEY CHECK (id = 1), certificate TEXT NOT NULL, revocations TEXT NOT NULL, signed REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS appliance (
    key TEXT PRIMARY KEY, endpoint TEXT NOT NULL, pin TEXT NOT NULL, certificate TEXT NOT NULL, serial TEXT NOT NULL,
    expires REAL NOT NULL
) WITHOUT ROWID;
"""
_LONGEST_SECONDS = 398 * 86_400.0  # the longest life of a certificate that the authority makes


class HostRow(NamedTuple):
    """An enrolled host. A name always keeps its virtual address; times are seconds since the epoch."""

    name: str
    address: str
    serial: str
    expires: float
    enrolled: float
    revoked: float | None


class NextCertificate(NamedTuple):
    """A certificate that its host has received and not yet confirmed as installed."""

    serial: str
    expires: float
    certificate: str


class CertificateRow(NamedTuple):
    """The certificate (PEM) of a host, the time when it was made, and its successor."""

    name: str
    made: float
    certificate: str
    next: NextCertificate | None = None


class PortsRow(NamedTuple):
    """The check of a machine's ROS ports from outside; `name` is a host or an address."""

    name: str
    state: str
    open: list[int]
    checked: float
    who: str


class EnrolmentTokenRow(NamedTuple):
    """An awaited host and the hash of its one-time token; each name has at most one token."""

    name: str
    id: str
    hash: bytes
    created: float
    expires: float
    address: str
    days: float
    kit: dict[str, str]
    who: str


class RevokedCertificateRow(NamedTuple):
    """A revoked certificate. `name` is empty if not known."""

    serial: str
    name: str
    moment: float
    expires: float


class HostBlockRow(NamedTuple):
    """A host that an operator blocks; `since` is seconds since the epoch. Its end is in `EndTable`, if it has one."""

    address: str
    since: float
    who: str
    note: str


class AuthorityRow(NamedTuple):
    """The certificate (PEM) of the hosts' authority, and its last list of revoked certificates (PEM)."""

    certificate: str
    revocations: str
    signed: float


class ApplianceRow(NamedTuple):
    """One of two appliances: the fingerprint of its tunnel key, and the certificate (PEM) for it."""

    key: str
    endpoint: str
    pin: str
    certificate: str
    serial: str
    expires: float


class HostTables:
    """The rows of hosts in the state file."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def together(self) -> AbstractContextManager[None]:
        """Store all changes of the block, or none if the process dies."""
        return self._database.together()

    def save(self, row: HostRow) -> None:
        self._database.put("host", *row)

    def hosts(self) -> list[HostRow]:
        return [HostRow(*row) for row in self._database.query("SELECT * FROM host ORDER BY name")]

    def save_certificate(self, row: CertificateRow) -> None:
        self._database.put("host_certificate", *row[:-1], *(row.next or (None, None, None)))

    def certificates(self) -> list[CertificateRow]:
        return [
            CertificateRow(
                name, made, certificate, NextCertificate(*following) if following[0] is not None else None
            )
            for name, made, certificate, *following in self._database.query("SELECT * FROM host_certificate")
        ]

    def save_ports(self, row: PortsRow) -> None:
        self._database.put("host_ports", row.name, row.state, json.dumps(row.open), row.checked, row.who)

    def ports(self) -> list[PortsRow]:
        rows = self._database.query("SELECT * FROM host_ports")
        return [PortsRow(name, state, json.loads(opened), *told) for name, state, opened, *told in rows]

    def save_awaited(self, row: EnrolmentTokenRow) -> None:
        self._database.put("enrolment_token", *row[:-2], json.dumps(row.kit), row.who)

    def forget_awaited(self, name: str) -> None:
        self._database.delete("enrolment_token", name=name)

    def enrolment_tokens(self) -> list[EnrolmentTokenRow]:
        rows = self._database.query("SELECT * FROM enrolment_token")
        return [EnrolmentTokenRow._make((*row[:-2], json.loads(row[-2]), row[-1])) for row in rows]

    def save_revoked(self, row: RevokedCertificateRow) -> None:
        self._database.put("revocation", *row)

    def forget_revoked(self, serial: str) -> None:
        with self.together():
            self._database.delete("revocation", serial=serial)
            self._database.delete("revoked_certificate", serial=serial)

    def revoked_certificates(self) -> list[RevokedCertificateRow]:
        # Rows of the older table `revoked_certificate` have no expiry: assume the longest life of a certificate.
        rows = self._database.query(
            "SELECT serial, name, moment, expires FROM revocation UNION ALL"
            " SELECT serial, '', moment, moment + ? FROM revoked_certificate"
            " WHERE serial NOT IN (SELECT serial FROM revocation) ORDER BY moment",
            (_LONGEST_SECONDS,),
        )
        return [RevokedCertificateRow(*row) for row in rows]

    def save_block(self, row: HostBlockRow) -> None:
        self._database.put("host_block", row.address, row.since, None, row.who, row.note)

    def forget_block(self, address: str) -> None:
        self._database.delete("host_block", address=address)

    def blocks(self) -> list[HostBlockRow]:
        rows = self._database.query("SELECT address, since, who, note FROM host_block ORDER BY since")
        return [HostBlockRow(*row) for row in rows]

    def save_authority(self, row: AuthorityRow) -> None:
        self._database.put("authority", 1, *row)

    def authority(self) -> AuthorityRow | None:
        rows = self._database.query("SELECT certificate, revocations, signed FROM authority")
        return AuthorityRow(*rows[0]) if rows else None

    def save_appliance(self, row: ApplianceRow) -> None:
        self._database.put("appliance", *row)

    def forget_appliance(self, key: str) -> None:
        self._database.delete("appliance", key=key)

    def appliances(self) -> list[ApplianceRow]:
        return [ApplianceRow(*row) for row in self._database.query("SELECT * FROM appliance")]
