"""What is asked about hosts, by operators and by the hosts themselves, carried out."""

import time
from collections.abc import Awaitable, Callable

from appliance.channel import admin
from appliance.channel.answers import hosts as answers
from appliance.hosts.hosts import Hosts


class HostOrders:
    """Each method answers the request that it takes. They raise `HostRefusedError`, `HostsChangedError`.

    `carried_out()` waits until the relays have carried out what they were told: who was told that a host is out finds
    its connections closed.
    """

    def __init__(self, hosts: Hosts, carried_out: Callable[[], Awaitable[None]]) -> None:
        self._hosts = hosts
        self._carried_out = carried_out

    async def listed(self, _request: admin.HostList) -> answers.Hosts:
        """All hosts, and how the tunnels stand."""
        return self._hosts.overview()

    async def kit(self, request: admin.HostKit) -> answers.KitParts:
        """What an enrolled host's kit is made of now."""
        return await self._hosts.kit(request.name)

    async def endpoint(self, _request: admin.HostEndpoint) -> answers.Endpoint:
        """Where hosts reach the appliance."""
        return await self._hosts.endpoint()

    async def add(self, request: admin.HostAdd, who: str) -> answers.KitParts:
        """Enrol a host."""
        return await self._hosts.add(
            request.name,
            request.request,
            days=request.days,
            address=request.address,
            who=who,
            expected=request.expected,
        )

    async def token(self, request: admin.HostToken, who: str) -> answers.EnrolmentToken:
        """A one-time token for a host."""
        return await self._hosts.token(
            request.name,
            kit={
                "endpoint": request.endpoint or "",
                "ports": request.ports,
                "open": ",".join(request.open),
            },
            seconds=request.token_seconds,
            days=request.days,
            address=request.address,
            new=request.new,
            who=who,
            expected=request.expected,
        )

    async def renew(self, request: admin.HostRenew, who: str) -> answers.KitParts:
        """A new certificate for an enrolled host."""
        return await self._hosts.renew(
            request.name, request.request, days=request.days, who=who, expected=request.expected
        )

    async def revoke(self, request: admin.HostRevoke, who: str) -> answers.Revoked:
        """Let a host in no more."""
        revoked = await self._hosts.revoke(request.name, who, request.expected)
        await self._carried_out()
        return revoked

    async def ports(self, request: admin.HostPorts, who: str) -> answers.PortsTold:
        """Somebody tried a machine's ROS ports."""
        checked = time.time() if request.checked is None else request.checked
        return await self._hosts.ports.tell(
            request.name, request.state, request.open, checked=checked, who=who, expected=request.expected
        )

    async def reload(self, request: admin.HostsReload, who: str) -> answers.Reloaded:
        """Read hosts.yaml again."""
        reloaded = await self._hosts.reload(who, request.expected)
        await self._carried_out()
        return reloaded

    # --- what a host asks itself ---

    async def enrol(self, request: admin.HostEnrol) -> answers.KitParts:
        """A host brings its one-time token."""
        return await self._hosts.itself.enrol(request.token, request.request, request.peer)

    async def renew_itself(self, request: admin.HostRenewItself) -> answers.NewCertificate:
        """A host in its tunnel asks for its next certificate."""
        return await self._hosts.itself.renew(request.name, request.request, request.proof, request.peer)

    async def renewed(self, request: admin.HostRenewed) -> answers.Renewed:
        """A host has put its next certificate in place."""
        return await self._hosts.itself.renewed(request.name, request.peer)

    async def revocations(self, _request: admin.RevocationsWanted) -> answers.RevocationList:
        """The list of revoked certificates."""
        return await self._hosts.revocations()

    async def authority(self, _request: admin.AuthorityWanted) -> answers.AuthorityCertificate:
        """The authority's certificate."""
        return await self._hosts.authority()
