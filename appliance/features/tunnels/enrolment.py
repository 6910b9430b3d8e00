"""Carry out operators' requests about hosts with a tunnel: enrol, issue kits and one-time tokens, revoke.

Before its first `await`, a revocation removes the host from the policy, and its registrations. No answer contains
a private key, and only the answer to `token` contains a token.
"""

import asyncio
import hashlib
import ipaddress
import ssl
from collections.abc import Awaitable, Callable
from functools import partial

from appliance.base.counted import counted
from appliance.base.withdrawal import take_effect
from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import IpsecState
from appliance.channel.messages import EndpointFound
from appliance.configuration.settings import Settings
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels import tunnel_answers as answers
from appliance.features.tunnels.certification import Certification
from appliance.features.tunnels.checked_ports import PortChecks
from appliance.features.tunnels.enrolment_kit import filled
from appliance.features.tunnels.enrolment_tokens import LONGEST_SECONDS, MOST
from appliance.features.tunnels.host_view import HostView
from appliance.features.tunnels.rest_address import NO_TUNNELS
from appliance.features.tunnels.self_service import HostSelfService
from appliance.features.tunnels.tunnel_answers import Endpoint
from appliance.hosts.host_table import LONGEST_DAYS, HostRefusedError
from appliance.hosts.hosts_file import BUNDLED_HOSTS, DECLARED_HOSTS, DeclaredHostsError
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.policy.host_names import HostInWords
from appliance.policy.model import Address
from appliance.signing.fingerprints import fingerprint
from appliance.store.host_tables import EnrolmentTokenRow


class HostEnrolment(TunnelHosts):
    """Answers operators. Requests raise `HostRefusedError`, `HostsChangedError` and `StoreError`."""

    def __init__(
        self,
        certification: Certification,
        find_endpoint: Callable[[], Awaitable[answers.Endpoint]],
        *,
        expel: Callable[[Address, str], int],  # returns the number of removed registrations and grants
        # Waits until the relays have closed the connections of an expelled host.
        carried_out: Callable[[], Awaitable[None]],
        machines: Callable[[], dict[str, int]],
        in_words: HostInWords,
    ) -> None:
        self._certification = certification
        self._store = certification.store
        self._trail = certification.trail
        self._table = certification.table
        self._tunnels = certification.tunnels
        self._awaited = certification.awaited
        self._view = HostView(self._table, self._awaited, self._tunnels, in_words)
        self.itself = HostSelfService(certification)
        self.ports = PortChecks(certification, self._view, machines, in_words)
        self._find_endpoint = find_endpoint
        self._expel = expel
        self._carried_out = carried_out
        self._kept_text = self._store.settings().get(DECLARED_HOSTS, "")
        self._keep_text()

    # --- queries ---

    async def listed(self, _request: host_requests.HostList) -> answers.Hosts:
        machines = self.ports.in_clear_text()
        status = self._view.status(machines)
        return answers.Hosts(
            self._table.revision,
            self._view.rows(),
            self._view.machines(machines),
            esp=status.esp,
            key_exchange=status.key_exchange,
            post_quantum=status.post_quantum,
            pool=status.pool,
            address=status.address,
            hosts_file=status.hosts_file,
            troubles=status.troubles,
        )

    def status(self) -> IpsecState:
        return self._view.status(self.ports.in_clear_text())

    def rows(self) -> list[Host]:
        return self._view.rows()

    def served_by(self, pin: str) -> None:
        self._certification.served_by(pin)

    async def endpoint(self, _request: host_requests.HostEndpoint) -> answers.Endpoint:
        return await self._find_endpoint()

    async def kit(self, request: host_requests.HostKit) -> answers.KitParts:
        self._table.enrolled_row(request.name)
        return await self._certification.kit(request.name, None)

    # --- changes by operators ---

    async def add(self, request: host_requests.HostAdd, who: str) -> answers.KitParts:
        name = request.name
        async with self._certification.changing:
            self._table.require(request.expected)
            self._require_not_enrolled(name)
            self._table.require_name(name)
            wanted = self._table.address_for(name, request.address, self._awaited.addresses())
            await self._tunnels.open()
            with self._certification.unless_revoked(name):
                made = await self._certification.issue(name, request.request, request.days)
            take_effect()
            self._certification.enrolled(name, wanted, made, who)
            return await self._certification.finish(name)

    async def renew(self, request: host_requests.HostRenew, who: str) -> answers.KitParts:
        name = request.name
        async with self._certification.changing:
            self._table.require(request.expected)
            row = self._table.enrolled_row(name)
            await self._tunnels.open()
            with self._certification.unless_revoked(name):
                made = await self._certification.issue(name, request.request, request.days)
            take_effect()
            self._certification.keep(name, row.address, made)
            self._certification.renewed(name, row.serial, made.serial, made.expires, who)
            return await self._certification.finish(name)

    async def token(self, request: host_requests.HostToken, who: str) -> answers.EnrolmentToken:
        name = request.name
        found = answers.Endpoint(request.endpoint, "") if request.endpoint else await self._find_endpoint()
        async with self._certification.changing:
            self._table.require(request.expected)
            self._table.require_name(name)
            if request.new:
                self._require_not_enrolled(name)
            await self._require_token_possible(request)
            promised = self._table.address_for(name, request.address, self._awaited.addresses())
            await self._tunnels.open()
            authority = await self._certification.authority_certificate()
            take_effect()
            row, text = self._awaited.add(
                name,
                seconds=request.token_seconds,
                address=promised,
                days=request.days,
                kit={"endpoint": found.endpoint, "ports": request.ports, "open": ",".join(request.open)},
                who=who,
            )
            self._table.changed()
            self._trail.happened(
                "host awaited",
                f"the host that presents the one-time token {row.id} is enrolled as {name}",
                name=name,
                address=promised,
                id=row.id,
                expires=row.expires,
                who=who,
            )
            await self._store.settled()
            place = f"[{found.endpoint}]" if ":" in found.endpoint else found.endpoint
            url = f"https://{place}:{self._certification.rest.port}"
            # The script contains no token. It makes the key on the host, and the key never leaves that host. It checks
            # the pin of REST's key and the authority's fingerprint, so a man in the middle learns nothing.
            known = {"url": url, "pin": self._certification.served.pin, "authority": _fingerprint(authority)}
            return answers.EnrolmentToken(
                revision=self._table.revision,
                name=name,
                address=promised,
                token=text,
                expires=row.expires,
                endpoint=found.endpoint,
                endpoint_reason=found.reason,
                **known,
                script=filled("enrol.sh", {"name": name, **known}),
            )

    async def revoke(self, request: host_requests.HostRevoke, who: str) -> answers.Revoked:
        name = request.name
        self._table.require(request.expected)
        self._certification.revoked(name)
        awaited = self._awaited.rows().get(name)
        self._awaited.forget(name)
        if awaited is not None and (
            name not in self._table.rows or self._table.rows[name].revoked is not None
        ):
            return await self._await_no_longer(awaited, who)
        row = self._table.revoke(name)
        self._tunnels.state_anew()
        taken = self._certification.changed()
        taken += self._expel(ipaddress.ip_address(row.address), f"the host {name} was revoked")
        self._trail.happened(
            "host revoked",
            f"{name} ({row.address}) may no longer connect;"
            f" {counted(taken, 'registration or grant was', 'registrations and grants were')} removed",
            name=name,
            address=row.address,
            serial=row.serial,
            taken_back=taken,
            who=who,
        )
        await self._store.settled()
        await self._carried_out()
        return answers.Revoked(self._table.revision, name, row.address, row.serial, taken)

    async def reload(self, request: host_requests.HostsReload, who: str) -> answers.Reloaded:
        """Read hosts.yaml again. An invalid file changes nothing."""
        self._table.require(request.expected)
        return await self._declare(self._table.declared.reload, who)

    async def read_again(self, who: str) -> None:
        await self.reload(host_requests.HostsReload(), who)

    async def take_bundle(self, text: str, who: str) -> answers.Reloaded:
        """Put a bundle's hosts into force. An empty string stands for hosts.yaml."""
        declared = self._table.declared
        return await self._declare(partial(declared.take, text) if text else declared.reload, who)

    @property
    def bundled(self) -> str:
        return self._table.declared.bundled

    async def _declare(self, read: Callable[[], None], who: str) -> answers.Reloaded:
        before = {row.name for row in self._table.admitted()}
        earlier = self._table.declared.in_force
        try:
            read()
        except DeclaredHostsError as error:
            raise HostRefusedError(f"{error}; the previous declaration stays in force") from error
        self._store.save_setting(BUNDLED_HOSTS, self._table.declared.bundled)
        self._keep_text()
        after = {row.name for row in self._table.admitted()}
        self._table.changed()
        taken = 0
        if before != after:
            taken = self._certification.changed()
            self._tunnels.state_anew()
        for name in sorted(before - after):
            address = ipaddress.ip_address(self._table.rows[name].address)
            taken += self._expel(address, f"hosts.yaml no longer wants the tunnel of {name}")
        meant = self._tunnels.addresses
        await self._tunnels.start()
        if self._tunnels.addresses != meant:  # `start` opened the first tunnel and blocked clear text
            taken += self._certification.changed()
        divergence = [f"{row.name}: {row.divergence}" for row in self._view.rows() if row.divergence]
        now = self._table.declared.in_force
        self._trail.happened(
            "hosts reloaded",
            f"{self._table.declared.source}: {counted(len(self._table.declared.hosts), 'host is', 'hosts are')}"
            " declared",
            opened=sorted(after - before),
            closed=sorted(before - after),
            sha256=fingerprint(now),
            earlier_sha256=fingerprint(earlier),
            diff=self._table.declared.changed_lines(earlier),
            taken_back=taken,
            divergence=divergence,
            who=who,
        )
        await self._carried_out()
        return answers.Reloaded(
            self._table.revision,
            sorted(self._table.declared.hosts),
            sorted(after - before),
            sorted(before - after),
            divergence,
        )

    def _keep_text(self) -> None:
        text = self._table.declared.text
        if text != self._kept_text:
            self._store.save_setting(DECLARED_HOSTS, text)
            self._kept_text = text

    def _require_not_enrolled(self, name: str) -> None:
        row = self._table.rows.get(name)
        if row is not None and row.revoked is None:
            raise HostRefusedError(
                f"{name} is already enrolled: `rosrv host kit {name}` issues a new certificate"
            )

    async def _require_token_possible(self, request: host_requests.HostToken) -> None:
        if not 0 < request.token_seconds <= LONGEST_SECONDS:
            raise HostRefusedError(
                f"a one-time token is valid for at most {LONGEST_SECONDS / 86_400:.0f} days"
            )
        if not 0 < request.days <= LONGEST_DAYS:
            raise HostRefusedError(f"a certificate is valid for at most {LONGEST_DAYS} days")
        if self._certification.rest.port is None:
            raise HostRefusedError(self._certification.rest.trouble)
        if not await self._certification.served.wait():
            raise HostRefusedError("REST is not running: see `rosrv status` and the log", ours=True)
        if len(self._awaited.rows()) >= MOST:
            raise HostRefusedError(f"{MOST} hosts are already awaited: revoke some")

    async def _await_no_longer(self, awaited: EnrolmentTokenRow, who: str) -> answers.Revoked:
        self._table.changed()
        self._trail.happened(
            "host awaited no longer",
            f"the one-time token {awaited.id} of {awaited.name} was revoked",
            name=awaited.name,
            address=awaited.address,
            id=awaited.id,
            expires=awaited.expires,
            who=who,
        )
        await self._store.settled()
        return answers.Revoked(self._table.revision, awaited.name, awaited.address, "", 0)


def _fingerprint(certificate: bytes) -> str:
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate.decode("ascii"))).hexdigest()


_ENDPOINT_SECONDS = 20.0


async def find_endpoint(settings: Settings, look: Callable[[], Awaitable[EndpointFound]]) -> Endpoint:
    if settings.isolation == "none":
        raise HostRefusedError(NO_TUNNELS)
    configured = settings.ipsec.endpoint
    if configured is not None:
        return Endpoint(configured, "ipsec.endpoint of the configuration")
    try:
        async with asyncio.timeout(_ENDPOINT_SECONDS):
            found = await look()
    except TimeoutError:
        raise HostRefusedError("the supervisor did not answer: try again", ours=True) from None
    if found.address is None:
        raise HostRefusedError(
            f"the address at which the host reaches the appliance is unknown: {found.reason}; give it:"
            " --appliance ADDRESS (REST: `endpoint`), or for all hosts `ipsec: {endpoint: ADDRESS}` in appliance.yaml"
            " (compose: ROSRV_ENDPOINT=ADDRESS in .env)"
        )
    return Endpoint(found.address, found.reason)
