"""Serve a host's own requests: enrol with a one-time token, renew its certificate through its tunnel.

1. A token is used up before the authority is asked, so if two hosts send the same token, only one gets a certificate.
   If no certificate is issued, the token becomes valid again, unless its name was revoked in between.
2. A host that renews must send from the virtual address of its name, which the firewall accepts only through IPsec.
   The signer checks the signature by the name's present key.
3. The present certificate stays valid until the host reports that it has installed the next one. If the host loses
   its connection in between, it can use either certificate.
"""

import asyncio
import ipaddress

from appliance.base import clock
from appliance.base.withdrawal import WithdrawnError, take_effect
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels.certification import Certification
from appliance.features.tunnels.enrolment_tokens import BadEnrolmentTokenError
from appliance.features.tunnels.host_view import span
from appliance.features.tunnels.tunnel_answers import KitParts, NewCertificate, Renewed
from appliance.hosts.host_table import HostForbiddenError, HostRefusedError
from appliance.store.host_tables import HostRow

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
                awaited = self._certification.awaited.take(request.token)
            except BadEnrolmentTokenError as error:
                self._trail.happened("enrolment refused", str(error), decision="deny", host=request.peer)
                raise HostForbiddenError(str(error)) from error
            name = awaited.name
            try:
                await self._tunnels.open()
                with self._certification.unless_revoked(name):
                    made = await self._certification.issue(name, request.request, awaited.days)
                take_effect()
            except HostForbiddenError:
                raise
            except (HostRefusedError, WithdrawnError):
                self._certification.awaited.give_back(awaited)
                raise
            self._certification.enrolled(
                name, awaited.address, made, awaited.who, token=awaited.id, peer=request.peer
            )
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
            with self._certification.unless_revoked(name):
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
            await self._certification.store.settled()
            authority = await self._certification.authority_certificate()
            return NewCertificate(
                name, made.serial, made.expires, made.certificate.decode(), authority.decode()
            )

    async def renewed(self, request: host_requests.HostRenewed) -> Renewed:
        name = request.name
        before = self._in_its_tunnel(name, request.peer).serial
        # Without the authority's key the previous certificate could not be put on the list of revoked certificates.
        await self._certification.require_authority()
        row = self._table.take_next(name)
        if row is None:
            raise HostRefusedError(f"{name} has no renewed certificate waiting: renew first")
        self._certification.renewed(name, before, row.serial, row.expires, name)
        await self._certification.store.settled()
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
