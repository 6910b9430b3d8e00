"""Certificates of hosts: asked of the signer, kept, told to charon, and given out as what a kit is made of.

Invariants:

1. What is under way for a name (an enrolment, a renewal) is refused when the name is revoked meanwhile, however it
   was begun.
2. Every certificate that is given or taken is recorded.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from appliance.channel import admin
from appliance.channel.answers.host_answers import AuthorityCertificate, KitParts, RevocationList
from appliance.channel.messages import CertificateMade
from appliance.hosts.certificate_requests import Authority, AuthorityError
from appliance.hosts.enrolment_tokens import Awaited
from appliance.hosts.host_table import HostForbiddenError, HostRefusedError, HostTable
from appliance.hosts.rest_place import RestPlace
from appliance.hosts.tunnel_state import Tunnels
from appliance.hosts.view import soon
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

_SERVED_SECONDS = 10.0


class Certification:
    """What enrolment by an operator and by a host itself have in common.

    `changed()` is called when it has changed who is enrolled, and says how much was taken back for that.
    """

    def __init__(
        self,
        store: StateStore,
        trail: AuditTrail,
        authority: Authority,
        table: HostTable,
        tunnels: Tunnels,
        *,
        master_port: int,
        rest: RestPlace,
        changed: Callable[[], int],
    ) -> None:
        self.store = store
        self.trail = trail
        self.table = table
        self.tunnels = tunnels
        self.rest = rest
        self.awaited = Awaited(store.hosts)
        self.changing = asyncio.Lock()
        self.changed = changed
        self._authority = authority
        self._master_port = master_port
        self._revocations: Counter[str] = Counter()  # of each name, in this life
        self._warned: set[str] = set()  # serials
        self.pin = ""
        self._served = asyncio.Event()

    def served_by(self, pin: str) -> None:
        """The api says by what hosts recognise it."""
        self.pin = pin
        self._served.set()

    def revoked(self, name: str) -> None:
        """A name is revoked: what is under way for it comes to nothing."""
        self._revocations[name] += 1

    @contextlib.contextmanager
    def unless_revoked(self, name: str) -> Iterator[None]:
        """What a block awaits comes to nothing when the name is revoked meanwhile."""
        before = self._revocations[name]
        yield
        if self._revocations[name] != before:
            raise HostForbiddenError(f"{name} was revoked meanwhile")

    async def issue(
        self, name: str, request: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        """Ask the authority. Raises `HostRefusedError`."""
        self.table.require_room(name)
        try:
            return await self._authority.issue(request.encode(), name, days, proof=proof, former=former)
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=not error.refused) from error

    def enrolled(self, name: str, address: str, made: CertificateMade, who: str, **more: Any) -> None:
        """A host has its first certificate, or another after it was revoked."""
        self.awaited.forget(name)
        self.keep(name, address, made)
        self.trail.happened(
            "host enrolled",
            f"{name} may come through its tunnel as {address}",
            name=name,
            address=address,
            serial=made.serial,
            expires=made.expires,
            who=who,
            **more,
        )

    def renewed(self, name: str, before: str, serial: str, expires: float, who: str) -> None:
        """Record that a host has another certificate in the place of the one before."""
        self.trail.happened(
            "host renewed",
            f"{name} has a new certificate; its tunnel comes back with it",
            name=name,
            serial=serial,
            replaced=before,
            expires=expires,
            who=who,
        )

    def keep(self, name: str, address: str, made: CertificateMade) -> None:
        """This is the certificate of the host now; charon and the policy are told."""
        self.table.keep(name, address, made)
        self.tunnels.state_anew()
        self.changed()

    async def finish(self, name: str, kept: dict[str, str] | None = None) -> KitParts:
        """The answer to an enrolment, when all of it is on the disk and charon knows it; `kept`: with its token.

        Raises `HostRefusedError`, `StoreError`.
        """
        try:
            await self.store.settled()
        except StoreError as error:
            stands = f"{name} is enrolled until then and has no kit: rosrv host kit {name}, or revoke it"
            raise StoreError(f"{error}; {stands}") from error
        taken = await self.tunnels.until_taken()
        warning = None if taken else "charon does not know it yet; `rosrv status` and the log say why"
        return await self.kit(name, warning, kept)

    async def kit(self, name: str, warning: str | None, kept: dict[str, str] | None = None) -> KitParts:
        """What a host's kit is made of. Raises `HostRefusedError`."""
        if self.rest.inner_port is not None and not await self.until_served():
            warning = warning or "REST is not there: the kit cannot renew its certificate by itself"
        authority = await self.authority_certificate()
        own, rest = self.table.own_address, self.rest
        row, certificate = self.table.rows[name], self.table.certificates.get(name)
        if certificate is None or not certificate.certificate:
            raise HostRefusedError(f"the certificate of {name} is not kept here: rosrv host kit {name}")
        return KitParts(
            revision=self.table.revision,
            name=name,
            address=row.address,
            appliance=own,
            master=f"http://{own}:{self._master_port}",
            rest_url=f"https://{own}:{rest.inner_port}" if rest.inner_port is not None else "",
            rest_trouble=rest.trouble,
            pin=self.pin,
            warning=warning,
            serial=row.serial,
            expires=row.expires,
            certificate=certificate.certificate,
            authority=authority.decode(),
            kept=kept or {},
        )

    async def revocations(self, _request: admin.RevocationsWanted) -> RevocationList:
        """The authority's list of revoked certificates, in PEM. Raises `HostRefusedError`."""
        try:
            listed = await self.tunnels.revocations.signed()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error
        return RevocationList(listed.decode())

    async def authority(self, _request: admin.AuthorityWanted) -> AuthorityCertificate:
        """The authority's certificate, in PEM. Raises `HostRefusedError`."""
        return AuthorityCertificate((await self.authority_certificate()).decode())

    async def authority_certificate(self) -> bytes:
        """The authority's own, in PEM. Raises `HostRefusedError`."""
        try:
            return await self._authority.certificate()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error

    async def until_served(self) -> bool:
        """Wait until the api, which starts after control, is there; False when it does not come in time."""
        try:
            await asyncio.wait_for(self._served.wait(), _SERVED_SECONDS)
        except TimeoutError:
            return False
        return True

    def each_hour(self) -> None:
        """Certificates that follow ended ones count; those that end soon are recorded, once each."""
        now = time.time()
        self.table.revoked.forget_ended()
        for row in self.table.enrolled():
            if row.expires <= now:
                self.table.take_next(row.name)
        for row in self.table.enrolled():
            if soon(self.table, row, now) and row.serial not in self._warned:
                self._warned.add(row.serial)
                self.trail.happened(
                    "certificate ends soon" if row.expires > now else "certificate ended",
                    f"the certificate of {row.name} ends at {row.expires:.0f}; renewal or `rosrv host kit {row.name}`",
                    name=row.name,
                    serial=row.serial,
                    expires=row.expires,
                )
