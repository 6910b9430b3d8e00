"""The hosts that come through tunnels: enrolled, renewed, revoked here.

Invariants:

1. `addresses` (what `host:NAME` means in the policy) is empty until the supervisor has said that these addresses
   are taken through IPsec only: where clear text is not kept out, they stand for nobody.
2. A revoked host is out of the policy, and its registrations are taken back, before anything is awaited. Whatever is
   under way for its name (an enrolment, a renewal) is refused when it comes to its end.
3. Who renews himself is at the virtual address of the name he says, and has its present key.
4. No answer but the one to `token` has a token in it, and no answer has a private key.
"""

import asyncio
import contextlib
import hashlib
import ipaddress
import ssl
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import structlog

from appliance.audit.record import Severity
from appliance.channel.messages import CertificateMade
from appliance.master.authority import Authority, AuthorityError
from appliance.master.awaited import LONGEST_SECONDS, MOST, Awaited, BadEnrolmentTokenError
from appliance.master.declared import DeclaredHostsError
from appliance.master.host_table import HostForbiddenError, HostRefusedError, HostTable
from appliance.master.host_view import HostView, soon
from appliance.master.recorder import Recorder
from appliance.master.rest_place import RestPlace
from appliance.master.tunnels import Tunnels
from appliance.policy.model import Address
from appliance.store.hosts import AwaitedRow, HostRow, PortsRow
from appliance.store.state import StateStore

_log = structlog.get_logger()
_ANSWER_SECONDS = 1.0  # until the answer to a host has left through its tunnel
_SERVED_SECONDS = 10.0
_RENEWALS_SECONDS = 3600.0
_CLOCKS_DIFFER = 86_400.0


class Hosts:
    """All hosts.

    `changed()` is called when `addresses` has changed, `expel(address, reason)` takes back what a host has; both
    say how much that was. `machines()` is the number of nodes by address.
    """

    def __init__(
        self,
        store: StateStore,
        recorder: Recorder,
        authority: Authority,
        table: HostTable,
        tunnels: Tunnels,
        *,
        master_port: int,
        rest: RestPlace,
    ) -> None:
        self._store = store
        self._recorder = recorder
        self._authority = authority
        self._table = table
        self._tunnels = tunnels
        self._master_port = master_port
        self._rest = rest
        self._awaited = Awaited(store.hosts)
        self._view = HostView(table, self._awaited, tunnels)
        self._changing = asyncio.Lock()
        self._revocations: Counter[str] = Counter()  # of each name, in this life
        self._renewals: dict[str, float] = {}
        self._warned: set[str] = set()  # serials
        self._pin = ""
        self._served = asyncio.Event()
        self.changed: Callable[[], int] = lambda: 0
        self.expel: Callable[[Address, str], int] = lambda address, reason: 0  # noqa: ARG005 - set by control
        self.machines: Callable[[], dict[str, int]] = dict
        tunnels.each_hour = self._each_hour

    # --- what others ask ---

    @property
    def addresses(self) -> dict[str, Address]:
        """What `host:NAME` means now."""
        if not self._tunnels.enclosed:
            return {}
        return {row.name: ipaddress.ip_address(row.address) for row in self._table.admitted()}

    def overview(self) -> dict[str, Any]:
        """Every host and machine, and how the tunnels stand."""
        machines = self._machines()
        status = self._view.status(machines)
        return {
            "revision": self._table.revision,
            "hosts": self._view.rows(),
            "machines": self._view.machines(machines),
            **{name: status[name] for name in _OVERVIEW},
        }

    def status(self) -> dict[str, Any]:
        """For `rosrv status`."""
        return self._view.status(self._machines())

    def rows(self) -> list[dict[str, Any]]:
        """Every host, enrolled, awaited or declared."""
        return self._view.rows()

    def served_by(self, pin: str) -> None:
        """The api says by what hosts recognise it."""
        self._pin = pin
        self._served.set()

    async def start(self) -> None:
        """Before nodes are served: have the addresses closed to clear text, if any host is enrolled."""
        if not self._table.admitted():
            return
        try:
            await self._tunnels.open()
        except HostRefusedError as error:
            _log.error("enrolled hosts stay outside", reason=str(error))

    # --- what operators do ---

    async def add(
        self,
        name: str,
        request: str,
        *,
        days: float,
        who: str,
        address: str | None = None,
        expected: int | None = None,
    ) -> dict[str, Any]:
        """Enrol a host; what its kit is made of. Raises `HostRefusedError`, `HostsChangedError`."""
        async with self._changing:
            self._table.require(expected)
            self._require_not_enrolled(name)
            self._table.require_name(name)
            wanted = self._table.address_for(name, address, self._awaited.addresses())
            await self._tunnels.open()
            with self._unless_revoked(name):
                made = await self._issue(name, request, days)
            self._enrolled(name, wanted, made, who)
            return await self._finish(name)

    async def renew(
        self, name: str, request: str, *, days: float, who: str, expected: int | None = None
    ) -> dict[str, Any]:
        """A new certificate for a host, the one before revoked. Raises as `add`."""
        async with self._changing:
            self._table.require(expected)
            row = self._table.enrolled_row(name)
            await self._tunnels.open()
            with self._unless_revoked(name):
                made = await self._issue(name, request, days)
            self._keep(name, row.address, made)
            self._renewed(name, row.serial, made.serial, made.expires, who)
            return await self._finish(name)

    async def token(
        self,
        name: str,
        *,
        kit: dict[str, str],
        seconds: float,
        days: float,
        address: str | None,
        new: bool,
        who: str,
        expected: int | None = None,
    ) -> dict[str, Any]:
        """A one-time token for a host. Raises as `add`."""
        async with self._changing:
            self._table.require(expected)
            self._table.require_name(name)
            if new:
                self._require_not_enrolled(name)
            if not 0 < seconds <= LONGEST_SECONDS:
                raise HostRefusedError(
                    f"a one-time token ends after at most {LONGEST_SECONDS / 86_400:.0f} days"
                )
            if self._rest.port is None:
                raise HostRefusedError(self._rest.trouble)
            if not await self._until_served():
                raise HostRefusedError("REST is not there: `rosrv status` and the log say why", ours=True)
            if len(self._awaited.rows()) >= MOST:
                raise HostRefusedError(f"{MOST} hosts are awaited already: revoke some")
            promised = self._table.address_for(name, address, self._awaited.addresses())
            await self._tunnels.open()
            authority = await self._certificate_of_authority()
            row, text = self._awaited.add(
                name, seconds=seconds, address=promised, days=days, kit=kit, who=who
            )
            self._table.changed()
            self._recorder.happened(
                "host awaited",
                f"whoever brings the one-time token {row.id} is enrolled as {name}",
                severity=Severity.NOTICE,
                name=name,
                address=promised,
                id=row.id,
                expires=row.expires,
                who=who,
            )
            await self._store.settled()
            return {
                **self._places(),
                "revision": self._table.revision,
                "name": name,
                "address": promised,
                "token": text,
                "token_expires": row.expires,
                "authority_fingerprint": _fingerprint(authority),
            }

    async def revoke(self, name: str, who: str, expected: int | None = None) -> dict[str, Any]:
        """Let a host in no more and cut what it has; or await it no longer. Raises as `add`."""
        self._table.require(expected)
        self._revocations[name] += 1
        awaited = self._awaited.rows().get(name)
        self._awaited.forget(name)
        if awaited is not None and (
            name not in self._table.rows or self._table.rows[name].revoked is not None
        ):
            return await self._await_no_longer(awaited, who)
        row = self._table.revoke(name)
        self._tunnels.state_anew()
        taken = self.changed()
        taken += self.expel(ipaddress.ip_address(row.address), f"the host {name} was revoked")
        self._recorder.happened(
            "host revoked",
            f"{name} ({row.address}) may no longer come; {taken} registrations and grants were taken back",
            severity=Severity.WARNING,
            name=name,
            address=row.address,
            serial=row.serial,
            taken_back=taken,
            who=who,
        )
        await self._store.settled()
        return {
            "revision": self._table.revision,
            "name": name,
            "address": row.address,
            "serial": row.serial,
            "taken_back": taken,
        }

    async def reload(self, who: str, expected: int | None = None) -> dict[str, Any]:
        """Read hosts.yaml again: which tunnels are wanted. Raises as `add`; a bad file changes nothing."""
        self._table.require(expected)
        before = {row.name for row in self._table.admitted()}
        try:
            self._table.declared.reload()
        except DeclaredHostsError as error:
            raise HostRefusedError(f"{error}; what was declared before holds") from error
        after = {row.name for row in self._table.admitted()}
        self._table.changed()
        taken = 0
        if before != after:
            taken = self.changed()
            self._tunnels.state_anew()
        for name in sorted(before - after):
            address = ipaddress.ip_address(self._table.rows[name].address)
            taken += self.expel(address, f"hosts.yaml no longer wants the tunnel of {name}")
        divergence = [f"{row['name']}: {row['divergence']}" for row in self._view.rows() if row["divergence"]]
        self._recorder.happened(
            "hosts reloaded",
            f"{self._table.declared.path}: {len(self._table.declared.hosts)} hosts are declared",
            severity=Severity.NOTICE,
            opened=sorted(after - before),
            closed=sorted(before - after),
            taken_back=taken,
            divergence=divergence,
            who=who,
        )
        await self.start()
        return {
            "revision": self._table.revision,
            "declared": sorted(self._table.declared.hosts),
            "opened": sorted(after - before),
            "closed": sorted(before - after),
            "divergence": divergence,
        }

    async def kit(self, name: str) -> dict[str, Any]:
        """What an enrolled host's kit is made of now. Raises `HostRefusedError`."""
        self._table.enrolled_row(name)
        return await self._kit(name, None)

    async def tell_ports(
        self,
        name: str,
        state: str,
        opened: list[int],
        *,
        checked: float,
        who: str,
        expected: int | None = None,
    ) -> dict[str, Any]:
        """What somebody saw of a machine's ports from outside. Raises as `add`."""
        self._table.require(expected)
        key = self._known_machine(name)
        now = time.time()
        if checked > now + _CLOCKS_DIFFER:
            raise HostRefusedError("the moment of the check is more than a day ahead")
        row = PortsRow(key, state, sorted(set(opened))[:100], min(checked, now), who)
        self._table.keep_ports(row)
        self._recorder.happened(
            "ports checked",
            f"the ROS ports of {key} are {state}" + (f": {row.open}" if row.open else ""),
            severity=Severity.WARNING if state == "open" else Severity.NOTICE,
            name=key,
            state=state,
            open=row.open,
            checked=row.checked,
            who=who,
        )
        await self._store.settled()
        return {"revision": self._table.revision, "name": key, "ports": self._view.ports(key)}

    async def revocations(self) -> dict[str, Any]:
        """The authority's certificate and its list of revoked certificates, in PEM."""
        try:
            authority = await self._authority.certificate()
            listed = await self._authority.revocations(list(self._table.revoked))
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error
        return {"authority": authority.decode(), "revocations": listed.decode()}

    # --- what hosts do ---

    async def enrol(self, token: str, request: str, peer: str) -> dict[str, Any]:
        """A host brings its one-time token and a signing request. Raises `HostRefusedError`."""
        async with self._changing:
            try:
                awaited = self._awaited.take(token)
            except BadEnrolmentTokenError as error:
                self._recorder.happened(
                    "enrolment refused", str(error), severity=Severity.WARNING, decision="deny", host=peer
                )
                raise HostForbiddenError(str(error)) from error
            name = awaited.name
            try:
                await self._tunnels.open()
                with self._unless_revoked(name):
                    made = await self._issue(name, request, awaited.days)
            except HostForbiddenError:
                raise
            except HostRefusedError:
                self._awaited.give_back(awaited)
                raise
            self._enrolled(name, awaited.address, made, awaited.who, token=awaited.id, peer=peer)
            return {**await self._finish(name), "kit": awaited.kit}

    async def renew_itself(self, name: str, request: str, proof: bytes, peer: str) -> dict[str, Any]:
        """A host asks in its tunnel for its next certificate. Raises `HostRefusedError`."""
        async with self._changing:
            row = self._in_its_tunnel(name, peer)
            certificate = self._table.certificates.get(name)
            if certificate is None or not certificate.certificate:
                raise HostRefusedError(f"the certificate of {name} is not kept here: rosrv host kit {name}")
            life = row.expires - certificate.made
            self._require_patience(name, life)
            with self._unless_revoked(name):
                made = await self._issue(
                    name, request, life / 86_400, proof=proof, former=certificate.certificate.encode()
                )
            self._table.keep_next(name, made)
            self._renewals[name] = time.monotonic()
            await self._store.settled()
            authority = await self._certificate_of_authority()
            return {
                "name": name,
                "serial": made.serial,
                "expires": made.expires,
                "certificate": made.certificate.decode(),
                "authority": authority.decode(),
            }

    async def renewed(self, name: str, peer: str) -> dict[str, Any]:
        """A host has put its next certificate in place. Raises `HostRefusedError`."""
        before = self._in_its_tunnel(name, peer).serial
        row = self._table.take_next(name)
        if row is None:
            raise HostRefusedError(f"{name} was given no certificate that is to follow: renew first")
        self._renewed(name, before, row.serial, row.expires, name)
        await self._store.settled()
        asyncio.get_running_loop().call_later(_ANSWER_SECONDS, self._tunnels.state_anew)
        return {"name": name}

    # --- inside ---

    def _require_not_enrolled(self, name: str) -> None:
        row = self._table.rows.get(name)
        if row is not None and row.revoked is None:
            raise HostRefusedError(
                f"{name} is enrolled already: `rosrv host kit {name}` gives it a new certificate"
            )

    def _in_its_tunnel(self, name: str, peer: str) -> HostRow:
        address = ipaddress.ip_address(peer)
        mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
        row = self._table.at(str(mapped or address)) if self._tunnels.enclosed else None
        if row is None or row.name != name or not self._table.declared.wants(name):
            self._recorder.happened(
                "renewal refused",
                f"not in the tunnel of {name[:80]}",
                severity=Severity.WARNING,
                decision="deny",
                host=peer,
            )
            raise HostForbiddenError(f"{peer} is not the address of {name} in its tunnel")
        return row

    def _require_patience(self, name: str, life: float) -> None:
        wait = min(_RENEWALS_SECONDS, life / 10)
        since = time.monotonic() - self._renewals.get(name, -wait)
        if since < wait:
            raise HostRefusedError(f"{name} renewed {since:.0f} s ago: again in {wait - since:.0f} s")

    @contextlib.contextmanager
    def _unless_revoked(self, name: str) -> Iterator[None]:
        """What a block awaits comes to nothing when the name is revoked meanwhile."""
        before = self._revocations[name]
        yield
        if self._revocations[name] != before:
            raise HostForbiddenError(f"{name} was revoked meanwhile")

    async def _issue(
        self, name: str, request: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        try:
            return await self._authority.issue(request.encode(), name, days, proof=proof, former=former)
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=not error.refused) from error

    def _enrolled(self, name: str, address: str, made: CertificateMade, who: str, **more: Any) -> None:
        self._awaited.forget(name)
        self._keep(name, address, made)
        self._recorder.happened(
            "host enrolled",
            f"{name} may come through its tunnel as {address}",
            severity=Severity.NOTICE,
            name=name,
            address=address,
            serial=made.serial,
            expires=made.expires,
            who=who,
            **more,
        )

    def _renewed(self, name: str, before: str, serial: str, expires: float, who: str) -> None:
        self._recorder.happened(
            "host renewed",
            f"{name} has a new certificate; its tunnel comes back with it",
            severity=Severity.NOTICE,
            name=name,
            serial=serial,
            replaced=before,
            expires=expires,
            who=who,
        )

    async def _await_no_longer(self, awaited: AwaitedRow, who: str) -> dict[str, Any]:
        self._table.changed()
        self._recorder.happened(
            "host awaited no longer",
            f"the one-time token {awaited.id} of {awaited.name} was revoked",
            severity=Severity.NOTICE,
            name=awaited.name,
            id=awaited.id,
            who=who,
        )
        await self._store.settled()
        return {
            "revision": self._table.revision,
            "name": awaited.name,
            "address": awaited.address,
            "serial": "",
            "taken_back": 0,
        }

    def _keep(self, name: str, address: str, made: CertificateMade) -> None:
        self._table.keep(name, address, made)
        self._tunnels.state_anew()
        self.changed()

    async def _finish(self, name: str) -> dict[str, Any]:
        await self._store.settled()
        taken = await self._tunnels.until_taken()
        return await self._kit(
            name, None if taken else "charon does not know it yet; `rosrv status` and the log say why"
        )

    async def _kit(self, name: str, warning: str | None) -> dict[str, Any]:
        if self._rest.inner_port is not None and not await self._until_served():
            warning = warning or "REST is not there: the kit cannot renew its certificate by itself"
        authority = await self._certificate_of_authority()
        row, certificate = self._table.rows[name], self._table.certificates.get(name)
        if certificate is None or not certificate.certificate:
            raise HostRefusedError(f"the certificate of {name} is not kept here: rosrv host kit {name}")
        return {
            **self._places(),
            "revision": self._table.revision,
            "name": name,
            "address": row.address,
            "warning": warning,
            "serial": row.serial,
            "expires": row.expires,
            "certificate": certificate.certificate,
            "authority": authority.decode(),
            "authority_fingerprint": _fingerprint(authority),
        }

    async def _until_served(self) -> bool:
        """Wait until the api, which starts after control, is there; False when it does not come in time."""
        try:
            await asyncio.wait_for(self._served.wait(), _SERVED_SECONDS)
        except TimeoutError:
            return False
        return True

    def _places(self) -> dict[str, Any]:
        own, rest = self._table.own_address, self._rest
        return {
            "appliance": own,
            "master": f"http://{own}:{self._master_port}",
            "rest_port": rest.port,
            "rest_trouble": rest.trouble,
            "rest_url": f"https://{own}:{rest.inner_port}" if rest.inner_port is not None else "",
            "pin": self._pin,
        }

    async def _certificate_of_authority(self) -> bytes:
        try:
            return await self._authority.certificate()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error

    def _known_machine(self, name: str) -> str:
        if name in self._table.rows or name in self._table.declared.hosts:
            return name
        try:
            address = str(ipaddress.ip_address(name))
        except ValueError:
            self._table.enrolled_row(name)  # says which there are
            raise
        behind = [one.name for one in self._tunnels.seen.values() if one.remote == address]
        row = self._table.at(address)
        return row.name if row is not None else behind[0] if len(behind) == 1 else address

    def _machines(self) -> dict[str, int]:
        pool = self._table.pool
        return {
            address: nodes
            for address, nodes in self.machines().items()
            if not (one := ipaddress.ip_address(address)).is_loopback and one not in pool
        }

    def _each_hour(self) -> None:
        """Certificates that follow ended ones count; those that end soon are recorded, once each."""
        now = time.time()
        for row in self._table.enrolled():
            if row.expires <= now:
                self._table.take_next(row.name)
        for row in self._table.enrolled():
            if soon(self._table, row, now) and row.serial not in self._warned:
                self._warned.add(row.serial)
                self._recorder.happened(
                    "certificate ends soon" if row.expires > now else "certificate ended",
                    f"the certificate of {row.name} ends at {row.expires:.0f}; renewal or `rosrv host kit {row.name}`",
                    severity=Severity.WARNING,
                    name=row.name,
                    serial=row.serial,
                    expires=row.expires,
                )


_OVERVIEW = ("esp", "key_exchange", "post_quantum", "pool", "address", "hosts_file", "troubles")


def _fingerprint(certificate: bytes) -> str:
    """SHA-256 of a certificate (PEM), in hexadecimal."""
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate.decode("ascii"))).hexdigest()
