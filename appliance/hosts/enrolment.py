"""The hosts that come through tunnels, as operators deal with them: enrolled, awaited, given kits, revoked.

Each request about hosts is answered by the method that takes it, here, of `itself`, of `ports` or of `Certification`.

Invariants:

1. A revoked host is out of the policy, and its registrations are taken back, before anything is awaited.
2. No answer but the one to `token` has a token in it, and no answer has a private key.
"""

import hashlib
import ipaddress
import ssl
from collections.abc import Awaitable, Callable

from appliance.base.withdrawal import take_effect
from appliance.channel import admin
from appliance.channel.answers import host_answers as answers
from appliance.channel.answers.status import IpsecState
from appliance.hosts.certification import Certification
from appliance.hosts.checked_ports import CheckedPorts
from appliance.hosts.enrolment_tokens import LONGEST_SECONDS, MOST
from appliance.hosts.host_table import LONGEST_DAYS, HostRefusedError
from appliance.hosts.hosts_file import DeclaredHostsError
from appliance.hosts.self_service import SelfService
from appliance.hosts.view import HostView
from appliance.ipsec.enrolment_kit import filled
from appliance.policy.model import Address
from appliance.store.host_tables import AwaitedRow


class Hosts:
    """All hosts; `itself` is what they do themselves.

    `expel(address, reason)` takes back what a host has, and says how much that was. `find_endpoint()` finds where hosts
    reach the appliance, as `appliance.hosts.tunnel_address` has it; `machines()` is the number of nodes by address.
    `carried_out()` waits until the relays have carried out what they were told: who was told that a host is out finds
    its connections closed.
    """

    def __init__(
        self,
        certification: Certification,
        find_endpoint: Callable[[], Awaitable[answers.Endpoint]],
        *,
        expel: Callable[[Address, str], int],
        carried_out: Callable[[], Awaitable[None]],
        machines: Callable[[], dict[str, int]],
    ) -> None:
        self._certification = certification
        self._store = certification.store
        self._trail = certification.trail
        self._table = certification.table
        self._tunnels = certification.tunnels
        self._awaited = certification.awaited
        self._view = HostView(self._table, self._awaited, self._tunnels)
        self.itself = SelfService(certification)
        self.ports = CheckedPorts(certification, self._view, machines)
        self._find_endpoint = find_endpoint
        self._expel = expel
        self._carried_out = carried_out

    # --- what others ask ---

    async def listed(self, _request: admin.HostList) -> answers.Hosts:
        """Every host and machine, and how the tunnels stand."""
        machines = self.ports.in_clear_text()
        status = self._view.status(machines)
        return answers.Hosts(
            self._table.revision,
            self._view.rows(),
            self._view.machines(machines),
            **{name: getattr(status, name) for name in _OVERVIEW},
        )

    def status(self) -> IpsecState:
        """For `rosrv status`."""
        return self._view.status(self.ports.in_clear_text())

    def rows(self) -> list[answers.Host]:
        """Every host, enrolled, awaited or declared."""
        return self._view.rows()

    async def endpoint(self, _request: admin.HostEndpoint) -> answers.Endpoint:
        """Where hosts reach the appliance."""
        return await self._find_endpoint()

    async def kit(self, request: admin.HostKit) -> answers.KitParts:
        """What an enrolled host's kit is made of now. Raises `HostRefusedError`."""
        self._table.enrolled_row(request.name)
        return await self._certification.kit(request.name, None)

    # --- what operators do ---

    async def add(self, request: admin.HostAdd, who: str) -> answers.KitParts:
        """Enrol a host; what its kit is made of. Raises `HostRefusedError`, `HostsChangedError`."""
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

    async def renew(self, request: admin.HostRenew, who: str) -> answers.KitParts:
        """A new certificate for a host, the one before revoked. Raises as `add`."""
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

    async def token(self, request: admin.HostToken, who: str) -> answers.EnrolmentToken:
        """A one-time token for a host. Raises as `add`."""
        name = request.name
        found = answers.Endpoint(request.endpoint, "") if request.endpoint else await self._find_endpoint()
        async with self._certification.changing:
            self._table.require(request.expected)
            self._table.require_name(name)
            if request.new:
                self._require_not_enrolled(name)
            if not 0 < request.token_seconds <= LONGEST_SECONDS:
                raise HostRefusedError(
                    f"a one-time token ends after at most {LONGEST_SECONDS / 86_400:.0f} days"
                )
            if not 0 < request.days <= LONGEST_DAYS:
                raise HostRefusedError(f"a certificate is good for at most {LONGEST_DAYS} days")
            if self._certification.rest.port is None:
                raise HostRefusedError(self._certification.rest.trouble)
            if not await self._certification.until_served():
                raise HostRefusedError("REST is not there: `rosrv status` and the log say why", ours=True)
            if len(self._awaited.rows()) >= MOST:
                raise HostRefusedError(f"{MOST} hosts are awaited already: revoke some")
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
                f"whoever brings the one-time token {row.id} is enrolled as {name}",
                name=name,
                address=promised,
                id=row.id,
                expires=row.expires,
                who=who,
            )
            await self._store.settled()
            place = f"[{found.endpoint}]" if ":" in found.endpoint else found.endpoint
            url = f"https://{place}:{self._certification.rest.port}"
            # The script makes the key on the host, which it never leaves, and has no token. It knows the appliance by
            # the pin of REST's key and the fingerprint of the authority: who stands in between gets and gives nothing.
            known = {"url": url, "pin": self._certification.pin, "authority": _fingerprint(authority)}
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

    async def revoke(self, request: admin.HostRevoke, who: str) -> answers.Revoked:
        """Let a host in no more and cut what it has; or await it no longer. Raises as `add`."""
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
            f"{name} ({row.address}) may no longer come; {taken} registrations and grants were taken back",
            name=name,
            address=row.address,
            serial=row.serial,
            taken_back=taken,
            who=who,
        )
        await self._store.settled()
        await self._carried_out()
        return answers.Revoked(self._table.revision, name, row.address, row.serial, taken)

    async def reload(self, request: admin.HostsReload, who: str) -> answers.Reloaded:
        """Read hosts.yaml again: which tunnels are wanted. Raises as `add`; a bad file changes nothing."""
        self._table.require(request.expected)
        before = {row.name for row in self._table.admitted()}
        try:
            self._table.declared.reload()
        except DeclaredHostsError as error:
            raise HostRefusedError(f"{error}; what was declared before holds") from error
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
        if self._tunnels.addresses != meant:  # the first tunnel of all: only now is clear text kept out
            taken += self._certification.changed()
        divergence = [f"{row.name}: {row.divergence}" for row in self._view.rows() if row.divergence]
        self._trail.happened(
            "hosts reloaded",
            f"{self._table.declared.path}: {len(self._table.declared.hosts)} hosts are declared",
            opened=sorted(after - before),
            closed=sorted(before - after),
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

    def _require_not_enrolled(self, name: str) -> None:
        row = self._table.rows.get(name)
        if row is not None and row.revoked is None:
            raise HostRefusedError(
                f"{name} is enrolled already: `rosrv host kit {name}` gives it a new certificate"
            )

    async def _await_no_longer(self, awaited: AwaitedRow, who: str) -> answers.Revoked:
        self._table.changed()
        self._trail.happened(
            "host awaited no longer",
            f"the one-time token {awaited.id} of {awaited.name} was revoked",
            name=awaited.name,
            id=awaited.id,
            who=who,
        )
        await self._store.settled()
        return answers.Revoked(self._table.revision, awaited.name, awaited.address, "", 0)


def _fingerprint(certificate: bytes) -> str:
    """SHA-256 of a certificate (PEM), in hexadecimal."""
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate.decode("ascii"))).hexdigest()


_OVERVIEW = ("esp", "key_exchange", "post_quantum", "pool", "address", "hosts_file", "troubles")
