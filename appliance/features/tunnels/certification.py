"""Request hosts' certificates from the signer, store them, pass them to charon, and return the parts of kits.

An enrolment or renewal fails if its name is revoked before it ends. Every certificate that is issued or revoked
is recorded.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from appliance.base import clock
from appliance.channel.messages import CertificateMade
from appliance.configuration.sections import is_loopback
from appliance.configuration.settings import Settings
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels.enrolment_tokens import EnrolmentTokens
from appliance.features.tunnels.host_view import ending, outside_the_pool
from appliance.features.tunnels.tunnel_answers import AuthorityCertificate, KitParts, RevocationList
from appliance.hosts.appliances import Appliances
from appliance.hosts.certificate_requests import AuthorityError, StoredAuthority
from appliance.hosts.host_table import HostForbiddenError, HostRefusedError, HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

# Derive from the configuration where other machines, and hosts in tunnels, reach REST. No I/O.

NO_TUNNELS = (
    "isolation: none has no tunnels, because without a firewall their addresses can be forged: start the appliance with"
    " `isolation: netns` or `container`"
)


@dataclass(frozen=True)
class RestAddress:
    port: int | None
    """For other machines."""
    trouble: str
    """The reason and the remedy if there is no port for other machines."""
    inner_port: int | None
    """For hosts in tunnels, at the appliance's tunnel address."""


def rest_address(settings: Settings) -> RestAddress:
    if settings.isolation == "none":
        return RestAddress(None, NO_TUNNELS, None)
    if settings.api_address is None:
        return RestAddress(None, "REST is off: hosts cannot enrol themselves; set `api: 0.0.0.0:8443`", None)
    host, port = settings.api_address
    if not settings.api_tls:
        return RestAddress(None, "REST is in clear text (api_tls: off): hosts cannot enrol themselves", None)
    everywhere = settings.isolation == "netns" or host in ("0.0.0.0", "::")  # noqa: S104  compared only
    inner = port if everywhere else None
    trouble = _trouble_outside(settings, host, port, everywhere=everywhere)
    return RestAddress(None if trouble else port, trouble, inner)


def _trouble_outside(settings: Settings, host: str, port: int, *, everywhere: bool) -> str:
    if not everywhere and is_loopback(host):
        return f"REST listens on {host} only: for hosts to enrol themselves set `api: 0.0.0.0:{port}`"
    if not settings.api_published:
        return (
            "other machines cannot reach REST (api_published: off). For hosts to enrol themselves publish port"
            f" {port} of the container on an address of this machine, name their network in ROSRV_API_NETWORKS, and set"
            " ROSRV_API_PUBLISHED (docs/tunnels.md); a kit, without --token, needs no REST"
        )
    if not settings.api_networks:
        return (
            "only this machine may connect to REST: set `api_networks` to the network from which hosts enrol"
            " themselves, such as [192.168.1.0/24]"
        )
    return ""


_SERVED_SECONDS = 10.0


class ServedRest:
    """The pin of the key with which REST is served; empty before."""

    def __init__(self) -> None:
        self.pin = ""
        self._begun = asyncio.Event()

    def begin(self, pin: str) -> None:
        self.pin = pin
        self._begun.set()

    async def wait(self) -> bool:
        """Wait until REST is served; return False if it takes too long."""
        try:
            async with asyncio.timeout(_SERVED_SECONDS):
                await self._begun.wait()
        except TimeoutError:
            return False
        return True


class Certification:
    """The common steps of enrolment by operators and by hosts. Methods raise `HostRefusedError`."""

    def __init__(
        self,
        store: StateStore,
        trail: AuditTrail,
        authority: StoredAuthority,
        table: HostTable,
        tunnels: Tunnels,
        *,
        appliances: Appliances,
        master_port: int,
        rest: RestAddress,
        ends: EndTable,
        changed: Callable[[], int],
    ) -> None:
        self.store = store
        self.trail = trail
        self.table = table
        self.tunnels = tunnels
        self.rest = rest
        self.awaited = EnrolmentTokens(store.hosts, ends)
        self.changing = asyncio.Lock()
        self.changed = changed
        self._authority = authority
        self._appliances = appliances
        self._master_port = master_port
        # The name that gets a certificate, and its address, until it is revoked; at most one, by `changing`.
        self._begun = ("", "")
        self._warned: set[tuple[str, str]] = set()  # the events that have a record, with serial numbers
        self.served = ServedRest()

    def served_by(self, pin: str) -> None:
        self._appliances.is_served(pin)
        self.served.begin(pin)

    def abandon(self, name: str) -> str:
        """End the enrolment or renewal that is in progress for this name; return its address, empty without one."""
        begun, address = self._begun
        if begun != name:
            return ""
        self._begun = ("", "")
        return address

    @contextlib.contextmanager
    def unless_revoked(self, name: str, address: str) -> Iterator[None]:
        """Raise `HostForbiddenError` at the end if the name was revoked in the block."""
        self._begun = (name, address)
        try:
            yield
            if self._begun[0] != name:
                raise HostForbiddenError(
                    f"{name} was revoked in the meantime: enrol it again (rosrv host add {name})"
                )
        finally:
            self._begun = ("", "")

    async def require_authority(self) -> None:
        try:
            await self._authority.require_key()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error

    async def issue(
        self, name: str, request: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        self.table.require_room(name)
        try:
            return await self._authority.issue(request.encode(), name, days, proof=proof, former=former)
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=not error.refused) from error

    def enrolled(self, name: str, address: str, made: CertificateMade, who: str, **more: Any) -> None:
        self.keep(name, address, made)
        self.trail.happened(
            "host enrolled",
            f"{name} may connect through its tunnel as {address}",
            name=name,
            address=address,
            serial=made.serial,
            expires=made.expires,
            who=who,
            **more,
        )

    def renewed(self, name: str, before: str, serial: str, expires: float, who: str) -> None:
        self.trail.happened(
            "host renewed",
            f"{name} has a new certificate; its tunnel reconnects with it",
            name=name,
            serial=serial,
            replaced=before,
            expires=expires,
            who=who,
        )

    def keep(self, name: str, address: str, made: CertificateMade) -> None:
        self.table.keep(name, address, made)
        self.tunnels.state_anew()
        self.changed()

    async def finish(self, name: str, kept: dict[str, str] | None = None) -> KitParts:
        """Return the parts of the kit once charon has the certificate, or with a warning if it does not confirm in
        time.

        `kept` are the options stored with the host's token.
        """
        taken = (
            await self.tunnels.until_taken()
        )  # the list of revoked certificates is signed and stored by then
        try:
            await self.store.until_settled()
        except StoreError as error:
            stands = f"{name} is enrolled until then and has no kit: rosrv host kit {name}, or revoke it"
            raise StoreError(f"{error}; {stands}") from error
        warning = None if taken else "charon has not loaded it yet; see `rosrv status` and the log"
        return await self.kit(name, warning, kept)

    async def kit(self, name: str, warning: str | None, kept: dict[str, str] | None = None) -> KitParts:
        if self.rest.inner_port is not None and not await self.served.wait():
            warning = warning or "REST is not running: the kit cannot renew its certificate automatically"
        authority = await self.authority_certificate()
        await self._appliances.until_introduced()
        own, rest, other = self.table.own_address, self.rest, self._appliances.other
        if self._appliances.paired and other is None:
            warning = warning or (
                "the other appliance has not connected yet, so the kit has this one only: later, rosrv host kit"
                f" {name}"
            )
        row, certificate = self.table.rows[name], self.table.certificates.get(name)
        if certificate is None or not certificate.certificate:
            raise HostRefusedError(
                f"the certificate of {name} is not stored here: issue a new one (rosrv host kit {name})"
            )
        if not self.table.is_for_hosts(row.address):
            raise HostRefusedError(outside_the_pool(self.table, row))
        return KitParts(
            revision=self.table.revision,
            name=name,
            address=row.address,
            appliance=own,
            master=f"http://{own}:{self._master_port}",
            rest_url=f"https://{own}:{rest.inner_port}" if rest.inner_port is not None else "",
            rest_trouble=rest.trouble,
            pin=";".join(filter(None, [self.served.pin, other.pin if other is not None else ""])),
            warning=warning,
            serial=row.serial,
            expires=row.expires,
            certificate=certificate.certificate,
            authority=authority.decode(),
            second=other.endpoint if other is not None else "",
            kept=kept or {},
        )

    async def revocations(self, _request: host_requests.RevocationsWanted) -> RevocationList:
        try:
            listed = await self.tunnels.revocations.signed_list()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error
        return RevocationList(listed.decode())

    async def authority(self, _request: host_requests.AuthorityWanted) -> AuthorityCertificate:
        return AuthorityCertificate((await self.authority_certificate()).decode())

    async def authority_certificate(self) -> bytes:
        try:
            return await self._authority.certificate()
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=True) from error

    def each_hour(self) -> None:
        """Adopt renewed certificates once the earlier ones have ended, and record each that ends soon or has ended."""
        now = clock.wall()
        self.table.revoked.forget_ended()
        for row in self.table.hosts():
            if row.expires <= now:
                self.table.take_next(row.name)
        for row in self.table.hosts():
            event = "certificate ends soon" if row.expires > now else "certificate ended"
            text = ending(self.table, row, now)
            if text and (event, row.serial) not in self._warned:
                self._warned.add((event, row.serial))
                self.trail.happened(
                    event,
                    text,
                    name=row.name,
                    serial=row.serial,
                    expires=row.expires,
                )
