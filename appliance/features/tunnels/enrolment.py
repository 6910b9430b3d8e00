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

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.withdrawal import take_effect
from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import IpsecState
from appliance.channel.messages import EndpointFound
from appliance.configuration.settings import Settings
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels import tunnel_answers as answers
from appliance.features.tunnels.certification import NO_TUNNELS, Certification
from appliance.features.tunnels.enrolment_kit import fill
from appliance.features.tunnels.enrolment_tokens import MAX, USED, BadEnrolmentTokenError
from appliance.features.tunnels.host_view import HostView, span
from appliance.features.tunnels.tunnel_answers import Endpoint, KitParts, NewCertificate, PortsReport, Renewed
from appliance.hosts.host_table import HostForbiddenError, HostRefusedError
from appliance.hosts.hosts_file import BUNDLED_HOSTS, DECLARED_HOSTS, DeclaredHostsError
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.policy.host_names import HostInWords
from appliance.policy.model import Address
from appliance.signing.fingerprints import fingerprint
from appliance.store.host_tables import EnrolmentTokenRow, HostRow, PortsRow

# Serve a host's own requests: enrol with a one-time token, renew its certificate through its tunnel.
#
# 1. If two hosts send the same token, only one gets a certificate: enrolments are carried out one by one, and each uses
#    its token up. A host to which the answer was lost gets it again for the same signing request.
# 2. A host that renews must send from the virtual address of its name, which the firewall accepts only through IPsec.
#    The signer checks the signature by the name's present key.
# 3. The present certificate stays valid until the host reports that it has installed the next one. If the host loses
#    its connection in between, it can use either certificate.

_ANSWER_SECONDS = 1.0  # time for the answer to leave through the host's tunnel
_RENEWALS = 20  # most renewals in a certificate's life; each lengthens the list of revoked certificates
_RENEWED = "hosts.renewed."


class HostSelfService:
    """Serves the requests that hosts make for themselves."""

    def __init__(self, certification: Certification) -> None:
        self._certification = certification
        self._table = certification.table
        self._tunnels = certification.tunnels
        self._trail = certification.trail
        kept = certification.store.settings()
        self._renewals = {  # time of the last renewal by name, in seconds since the epoch
            name.removeprefix(_RENEWED): float(moment)
            for name, moment in kept.items()
            if name.startswith(_RENEWED)
        }

    async def enrol(self, request: host_requests.HostEnrol) -> KitParts:
        async with self._certification.changing:
            try:
                awaited = self._certification.awaited.find(request.token, request.request, self._table.rows)
            except BadEnrolmentTokenError as error:
                self._trail.happened("enrolment refused", str(error), decision="deny", host=request.peer)
                raise HostForbiddenError(str(error)) from error
            name = awaited.name
            if USED in awaited.kit:
                return await self._certification.finish(name, awaited.kit)
            try:
                address = awaited.address
                if not self._table.is_for_hosts(address):
                    address = self._table.address_for(name, None, self._certification.awaited.addresses())
                with self._certification.unless_revoked(name, address):
                    await self._tunnels.open()
                    made = await self._certification.issue(name, request.request, awaited.days)
                take_effect()
            except HostForbiddenError as error:
                self._trail.happened(
                    "enrolment refused", str(error), decision="deny", host=request.peer, id=awaited.id
                )
                raise
            self._certification.enrolled(
                name, address, made, awaited.who, token=awaited.id, peer=request.peer
            )
            self._certification.awaited.use(awaited, request.request, made.serial)
            return await self._certification.finish(name, awaited.kit)

    async def renew(self, request: host_requests.HostRenewItself) -> NewCertificate:
        name = request.name
        async with self._certification.changing:
            row = self._in_its_tunnel(name, request.peer)
            certificate = self._table.certificates.get(name)
            if certificate is None or not certificate.certificate:
                raise HostRefusedError(
                    f"the certificate of {name} is not stored here: issue a new one (rosrv host kit {name})"
                )
            life = row.expires - certificate.made
            self._require_patience(name, life)
            with self._certification.unless_revoked(name, row.address):
                made = await self._certification.issue(
                    name,
                    request.request,
                    life / 86_400,
                    proof=request.proof,
                    former=certificate.certificate.encode(),
                )
            take_effect()
            self._table.keep_next(name, made)
            self._note_renewal(name)
            await self._certification.store.until_settled()
            authority = await self._certification.authority_certificate()
            return NewCertificate(
                name, made.serial, made.expires, made.certificate.decode(), authority.decode()
            )

    async def renewed(self, request: host_requests.HostRenewed) -> Renewed:
        name = request.name
        before = self._in_its_tunnel(name, request.peer).serial
        # Without the authority's key the previous certificate could not be put on the list of revoked certificates.
        await self._certification.require_authority()
        take_effect()
        row = self._table.take_next(name)
        if row is None:
            raise HostRefusedError(f"{name} has no renewed certificate waiting: renew first")
        self._certification.renewed(name, before, row.serial, row.expires, name)
        await self._certification.store.until_settled()
        asyncio.get_running_loop().call_later(_ANSWER_SECONDS, self._tunnels.state_anew)
        return Renewed(name)

    def _in_its_tunnel(self, name: str, peer: str) -> HostRow:
        address = ipaddress.ip_address(peer)
        mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
        row = self._table.at(str(mapped or address)) if self._tunnels.enclosed else None
        if row is None or row.name != name or not self._table.declared.wants(name):
            self._trail.happened(
                "renewal refused", f"not in the tunnel of {name[:80]}", decision="deny", host=peer
            )
            raise HostForbiddenError(
                f"{peer} is not the address of {name} in its tunnel: run this on {name}, while the tunnel is up"
            )
        return row

    def _require_patience(self, name: str, life: float) -> None:
        wait = life / _RENEWALS
        since = clock.wall() - self._renewals.get(name, -wait)
        if 0 <= since < wait:  # `since` is negative after the clock was set back; the host then need not wait
            raise HostRefusedError(f"{name} renewed {span(since)} ago: try again in {span(wait - since)}")

    def _note_renewal(self, name: str) -> None:
        self._renewals[name] = clock.wall()
        self._certification.store.save_setting(_RENEWED + name, repr(self._renewals[name]))


# Keep the results of port checks from other machines.

_CLOCKS_DIFFER = 86_400.0
_MAX_PORTS = 100


class PortChecks:
    """The results by machine; `machines()` returns the number of nodes by address."""

    def __init__(
        self,
        certification: Certification,
        view: HostView,
        machines: Callable[[], dict[str, int]],
        in_words: HostInWords,
    ) -> None:
        self._certification = certification
        self._table = certification.table
        self._tunnels = certification.tunnels
        self._trail = certification.trail
        self._view = view
        self._machines = machines
        self._in_words = in_words

    async def tell(self, request: host_requests.HostPorts, who: str) -> PortsReport:
        self._table.require(request.expected)
        key, state = self._known_machine(request.name), request.state
        now = clock.wall()
        checked = now if request.checked is None else request.checked
        if checked > now + _CLOCKS_DIFFER:
            raise HostRefusedError(
                "the time of the check is more than a day in the future: correct the clock of the host, or of the"
                " appliance"
            )
        row = PortsRow(key, state, sorted(set(request.open))[:_MAX_PORTS], min(checked, now), who)
        self._table.keep_ports(row)
        self._trail.happened(
            "ports checked",
            f"the ROS ports of {self._in_words(key)} are {state}" + (f": {row.open}" if row.open else ""),
            severity=Severity.WARNING if state == "open" else Severity.NOTICE,
            name=key,
            state=state,
            open=row.open,
            checked=row.checked,
            who=who,
        )
        await self._certification.store.until_settled()
        return PortsReport(self._view.ports(key), self._table.revision, key)

    def in_clear_text(self) -> dict[str, int]:
        pool = self._table.pool
        return {
            address: nodes
            for address, nodes in self._machines().items()
            if not (one := ipaddress.ip_address(address)).is_loopback and one not in pool
        }

    def _known_machine(self, name: str) -> str:
        if name in self._table.rows or name in self._table.declared.hosts:
            return name
        try:
            address = str(ipaddress.ip_address(name))
        except ValueError:
            self._table.enrolled_row(name)  # raises an error that lists the enrolled hosts
            raise
        behind = [tunnel.name for tunnel in self._tunnels.seen.values() if tunnel.remote == address]
        row = self._table.at(address)
        return row.name if row is not None else behind[0] if len(behind) == 1 else address


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

    async def list_hosts(self, _request: host_requests.HostList) -> answers.Hosts:
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
            with self._certification.unless_revoked(name, wanted):
                await self._tunnels.open()
                made = await self._certification.issue(name, request.request, request.days)
            take_effect()
            self._awaited.forget(name)
            self._certification.enrolled(name, wanted, made, who)
            return await self._certification.finish(name)

    async def renew(self, request: host_requests.HostRenew, who: str) -> answers.KitParts:
        name = request.name
        async with self._certification.changing:
            self._table.require(request.expected)
            row = self._table.enrolled_row(name)
            address = self._table.address_for(name, None, self._awaited.addresses())
            with self._certification.unless_revoked(name, address):
                await self._tunnels.open()
                made = await self._certification.issue(name, request.request, request.days)
            take_effect()
            self._certification.keep(name, address, made)
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
            await self._require_token_possible()
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
            await self._store.until_settled()
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
                script=fill("enrol.sh", {"name": name, "id": row.id, **known}),
            )

    async def revoke(self, request: host_requests.HostRevoke, who: str) -> answers.Revoked:
        name = request.name
        self._table.require(request.expected)
        begun = self._certification.abandon(name)
        awaited = None if begun else self._awaited.rows().get(name)
        self._awaited.forget(name)
        if (begun or awaited is not None) and (
            name not in self._table.rows or self._table.rows[name].revoked is not None
        ):
            return await self._await_no_longer(name, awaited.address if awaited else begun, awaited, who)
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
        await self._store.until_settled()
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
        before = {row.name for row in self._table.admitted_hosts()}
        earlier = self._table.declared.in_force
        try:
            read()
        except DeclaredHostsError as error:
            raise HostRefusedError(f"{error}; the previous declaration stays in force") from error
        self._store.save_setting(BUNDLED_HOSTS, self._table.declared.bundled)
        self._keep_text()
        after = {row.name for row in self._table.admitted_hosts()}
        now, diff = self._table.declared.in_force, self._table.declared.changed_lines(earlier)
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
        if (now, before, taken) != (earlier, after, 0):
            self._trail.happened(
                "hosts reloaded",
                f"{self._table.declared.source}: {counted(len(self._table.declared.hosts), 'host is', 'hosts are')}"
                " declared",
                opened=sorted(after - before),
                closed=sorted(before - after),
                sha256=fingerprint(now),
                earlier_sha256=fingerprint(earlier),
                diff=diff,
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

    async def _require_token_possible(self) -> None:
        if self._certification.rest.port is None:
            raise HostRefusedError(self._certification.rest.trouble)
        if not await self._certification.served.wait():
            raise HostRefusedError("REST is not running: see `rosrv status` and the log", ours=True)
        if len(self._awaited.rows()) >= MAX:
            raise HostRefusedError(f"{MAX} hosts are already awaited: revoke some")

    async def _await_no_longer(
        self, name: str, address: str, awaited: EnrolmentTokenRow | None, who: str
    ) -> answers.Revoked:
        """Without `awaited`, its enrolment had begun: that fails, and says so to the host."""
        self._table.changed()
        self._trail.happened(
            "host awaited no longer",
            f"the one-time token {awaited.id} of {name} was revoked"
            if awaited
            else f"{name} was revoked while it was being enrolled",
            name=name,
            address=address,
            more={"id": awaited.id, "expires": awaited.expires} if awaited else None,
            who=who,
        )
        await self._store.until_settled()
        return answers.Revoked(self._table.revision, name, address, "", 0)


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
