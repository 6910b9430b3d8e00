"""The table of hosts with a tunnel: names, addresses, certificates. It only keeps state.

1. No other host gets the virtual address of a name, even after a revocation. An address promised with a token is
   also reserved, and an address declared in hosts.yaml goes to another host only on request.
2. A replaced or revoked certificate is on the list of revoked certificates at once.
3. After a change of `ipsec.pool`, a host whose address is outside it is not admitted: in clear text, that address is
   anyone's. Its next certificate comes with another address.
4. `revision` grows with every change by an operator or a host, even across restarts.
5. A process that dies has stored all of a change, or nothing: otherwise a host's only certificate could be revoked.
"""

import datetime
import ipaddress
import itertools
import re

from appliance.base import clock
from appliance.base.shipped import earliest_now
from appliance.channel.messages import APPLIANCE_NAME, CertificateMade
from appliance.hosts.appliances import RevokedCertificates
from appliance.hosts.hosts_file import DeclaredHosts
from appliance.policy.model import Address
from appliance.store.host_tables import (
    CertificateRow,
    HostRow,
    NextCertificate,
    PortsRow,
    RevokedCertificateRow,
)
from appliance.store.state_file import StateStore

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?")
_REVISION = "hosts.revision"
MAX_HOSTS = 4096
MAX_MACHINES = 1024


class HostRefusedError(Exception):
    """A request is refused; the message has the reason. `ours`: the appliance, not the request, is the cause."""

    def __init__(self, reason: str, *, ours: bool = False) -> None:
        super().__init__(reason)
        self.ours = ours


class UnknownHostError(HostRefusedError):
    """No host has this name."""


class HostForbiddenError(HostRefusedError):
    """The caller may not make this request."""


class HostsChangedError(Exception):
    """A change expects another revision of the table."""


class HostTable:
    """All hosts; `own_address` is the appliance's, the first of the pool."""

    def __init__(self, store: StateStore, pool: ipaddress.IPv4Network, declared: DeclaredHosts) -> None:
        self._store = store
        self._kept = store.hosts
        self.pool = pool
        self.declared = declared
        self.rows = {row.name: row for row in self._kept.hosts()}
        self.certificates = {row.name: row for row in self._kept.certificates()}
        self.revoked = RevokedCertificates(self._kept)
        self.ports = {row.name: row for row in self._kept.ports()}
        self.revision = int(store.settings().get(_REVISION, "1"))

    @property
    def own_address(self) -> str:
        return str(self.pool.network_address + 1)

    def require(self, expected: int | None) -> None:
        """Raise `HostsChangedError` unless `expected` is None or the present revision."""
        if expected not in (None, self.revision):
            raise HostsChangedError(
                f"the table of hosts has revision {self.revision}, not {expected}: read it again (GET /v1/hosts)"
            )

    def changed(self) -> None:
        self.revision += 1
        self._store.save_setting(_REVISION, str(self.revision))

    # --- hosts in the table ---

    def hosts(self) -> list[HostRow]:
        return [row for row in self.rows.values() if row.revoked is None]

    def admitted_hosts(self) -> list[HostRow]:
        return [
            row for row in self.hosts() if self.declared.wants(row.name) and self.is_for_hosts(row.address)
        ]

    def is_for_hosts(self, address: str) -> bool:
        """Return whether hosts can have this address in the pool as it is now configured."""
        ends = (self.pool.network_address, self.pool.broadcast_address)
        one = ipaddress.IPv4Address(address)
        return one in self.pool and one not in ends and address != self.own_address

    def addresses(self) -> dict[str, Address]:
        """Return the addresses that the policy has for `host:NAME` while the tunnels are open."""
        return {row.name: ipaddress.ip_address(row.address) for row in self.admitted_hosts()}

    def enrolled_row(self, name: str) -> HostRow:
        """Return the row of an enrolled host. Raises `UnknownHostError`."""
        row = self.rows.get(name)
        if row is None or row.revoked is not None:
            known = ", ".join(host.name for host in self.hosts()[:20])
            others = f"the enrolled hosts: {known}" if known else "enrol it: rosrv host add NAME"
            raise UnknownHostError(f"no host {name[:80]!r} is enrolled; {others}")
        return row

    def at(self, address: str) -> HostRow | None:
        found = next((row for row in self.hosts() if row.address == address), None)
        return found if found is not None and self.is_for_hosts(address) else None

    def listed_as_revoked(self) -> list[RevokedCertificateRow]:
        return self.revoked.rows_to_send(self._enrolled_names())

    def missing_as_revoked(self) -> int:
        return self.revoked.missing(self._enrolled_names())

    def require_room(self, name: str) -> None:
        """Raise `HostRefusedError` if the list of revoked certificates is full."""
        if name not in self.rows:
            return
        until = self.revoked.wait_for_room(self._enrolled_names() | {name})
        if until:
            moment = datetime.datetime.fromtimestamp(until, datetime.UTC)
            raise HostRefusedError(
                "the list of revoked certificates is full (charon takes 64 KiB): no certificate is replaced before"
                f" {moment:%Y-%m-%d %H:%M}Z, when the next one on it expires; revoking a host also makes room"
            )

    def _enrolled_names(self) -> set[str]:
        return {row.name for row in self.hosts()}

    # --- names and addresses ---

    def require_name(self, name: str) -> None:
        """Raise `HostRefusedError` for an unusable name, or too many hosts."""
        if not _NAME.fullmatch(name) or name.lower() == APPLIANCE_NAME:
            raise HostRefusedError(
                f"{name[:80]!r} is not a valid host name: letters, digits and . _ -, beginning and ending with a"
                f" letter or digit, at most 63, and not {APPLIANCE_NAME}"
            )
        twin = next((other for other in self.rows if other.lower() == name.lower() and other != name), None)
        if twin is not None:
            raise HostRefusedError(
                f"{name} differs from {twin} only in letter case, which IKE ignores: choose another name"
            )
        if name not in self.rows and len(self.rows) >= MAX_HOSTS:
            raise HostRefusedError(
                f"the table is full: it has {MAX_HOSTS} hosts, including revoked ones, whose names can be enrolled"
                " again"
            )

    def address_for(self, name: str, wanted: str | None, awaited: dict[str, str]) -> str:
        """Return a free address for a host. Raises `HostRefusedError`.

        `awaited` has the addresses that are promised to hosts that will enrol, with their names.
        """
        declared = self.declared.hosts.get(name)
        before = self.rows.get(name)
        if before is not None and not self.is_for_hosts(before.address):
            before = None  # of another pool
        kept = before.address if before else declared.address if declared else None
        if wanted is None and kept is not None:
            wanted = kept
        taken = {row.address: row.name for row in self.rows.values() if row.name != name}
        taken |= {address: holder for address, holder in awaited.items() if holder != name}
        if wanted is None:
            reserved = {host.address for host in self.declared.hosts.values()}
            for candidate in itertools.islice(self.pool.hosts(), 1, None):
                if str(candidate) not in taken and str(candidate) not in reserved:
                    return str(candidate)
            raise HostRefusedError(f"no address of {self.pool} is free: set a larger ipsec.pool")
        try:
            address = ipaddress.IPv4Address(wanted)
        except ValueError:
            raise HostRefusedError(
                f"address: {wanted[:80]!r} is not an IPv4 address of {self.pool}"
            ) from None
        if not self.is_for_hosts(str(address)):
            where = " in hosts.yaml" if wanted is kept else ""
            raise HostRefusedError(
                f"{address} is not an address of a host in {self.pool}: leave it out{where}, for the next free one"
            )
        if str(address) in taken:
            raise HostRefusedError(f"{address} is the address of {taken[str(address)]}: choose another one")
        if before is not None and str(address) != before.address:
            raise HostRefusedError(
                f"{name} keeps {before.address} permanently: policies and logs identify it by that address"
            )
        return str(address)

    # --- changes ---

    def keep(self, name: str, address: str, made: CertificateMade) -> HostRow:
        before, now = self.rows.get(name), earliest_now()
        enrolled = before.enrolled if before is not None and before.revoked is None else now
        with self._kept.together():
            if before is not None and before.revoked is None:
                self._revoke_certificates(before)
            row = self._set(HostRow(name, address, made.serial, made.expires, enrolled, None))
            self._set_certificate(CertificateRow(name, now, made.certificate.decode()))
            self.changed()
        return row

    def keep_next(self, name: str, made: CertificateMade) -> None:
        row = self.certificates.get(name)
        before = row.certificate if row is not None else ""
        since = row.made if row is not None else earliest_now()
        following = NextCertificate(made.serial, made.expires, made.certificate.decode())
        with self._kept.together():
            if row is not None and row.next is not None:
                self.revoked.add(name, row.next.serial, row.next.expires)
            self._set_certificate(CertificateRow(name, since, before, following))
            self.changed()

    def take_next(self, name: str) -> HostRow | None:
        row, certificate = self.rows[name], self.certificates.get(name)
        if certificate is None or certificate.next is None:
            return None
        following = certificate.next
        # It was made for as long as the one before, counted from then: a host may confirm it much later.
        made = following.expires - (row.expires - certificate.made)
        with self._kept.together():
            self.revoked.add(name, row.serial, row.expires)
            taken = self._set(row._replace(serial=following.serial, expires=following.expires))
            self._set_certificate(CertificateRow(name, made, following.certificate))
            self.changed()
        return taken

    def revoke(self, name: str) -> HostRow:
        row = self.enrolled_row(name)
        with self._kept.together():
            self._revoke_certificates(row)
            self.changed()
            return self._set(row._replace(revoked=clock.wall()))

    def keep_ports(self, row: PortsRow) -> None:
        """Keep the check of a machine's ports. Raises `HostRefusedError` if there are too many machines."""
        if row.name not in self.ports and len(self.ports) >= MAX_MACHINES:
            raise HostRefusedError(f"the limit of {MAX_MACHINES} machines with known ports is reached")
        self.ports[row.name] = row
        self._kept.save_ports(row)
        self.changed()

    def _set(self, row: HostRow) -> HostRow:
        self.rows[row.name] = row
        self._kept.save(row)
        return row

    def _set_certificate(self, row: CertificateRow) -> None:
        self.certificates[row.name] = row
        self._kept.save_certificate(row)

    def _revoke_certificates(self, row: HostRow) -> None:
        self.revoked.add(row.name, row.serial, row.expires)
        certificate = self.certificates.get(row.name)
        if certificate is not None and certificate.next is not None:
            self.revoked.add(row.name, certificate.next.serial, certificate.next.expires)
            self._set_certificate(certificate._replace(next=None))
