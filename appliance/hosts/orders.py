"""What is asked about hosts over the admin socket and REST, carried out."""

import time
from typing import Any

from appliance.channel import admin
from appliance.hosts.hosts import Hosts

MINE = (
    admin.HostAdd, admin.HostToken, admin.HostEnrol, admin.HostRenew, admin.HostRenewItself, admin.HostRenewed,
    admin.HostList, admin.HostKit, admin.HostRevoke, admin.HostPorts, admin.HostsReload, admin.RevocationsWanted,
    admin.AuthorityWanted, admin.HostEndpoint,
)  # fmt: skip


async def manage_hosts(hosts: Hosts, request: admin.HostRequest, who: str) -> dict[str, Any]:
    """The answer's body. Raises `HostRefusedError`, `HostsChangedError`."""
    match request:
        case admin.HostList():
            return hosts.overview()
        case admin.HostKit(name):
            return await hosts.kit(name)
        case admin.HostEndpoint():
            return await hosts.endpoint()
        case (
            admin.HostEnrol()
            | admin.HostRenewItself()
            | admin.HostRenewed()
            | admin.RevocationsWanted()
            | admin.AuthorityWanted()
        ):
            return await _itself(hosts, request)
        case _:
            return await _change(hosts, request, who)


_OfItself = (
    admin.HostEnrol
    | admin.HostRenewItself
    | admin.HostRenewed
    | admin.RevocationsWanted
    | admin.AuthorityWanted
)


async def _itself(hosts: Hosts, request: _OfItself) -> dict[str, Any]:
    match request:
        case admin.HostEnrol(token, text, peer):
            return await hosts.itself.enrol(token, text, peer)
        case admin.HostRenewItself(name, text, proof, peer):
            return await hosts.itself.renew(name, text, proof, peer)
        case admin.HostRenewed(name, peer):
            return await hosts.itself.renewed(name, peer)
        case admin.RevocationsWanted():
            return await hosts.revocations()
        case admin.AuthorityWanted():
            return await hosts.authority()


_Change = (
    admin.HostAdd | admin.HostToken | admin.HostRenew | admin.HostRevoke | admin.HostPorts | admin.HostsReload
)


async def _change(hosts: Hosts, request: _Change, who: str) -> dict[str, Any]:
    match request:
        case admin.HostAdd(name, text, days, address, expected):
            return await hosts.add(name, text, days=days, address=address, who=who, expected=expected)
        case admin.HostToken(name, kit, seconds, days, address, expected, new):
            return await hosts.token(
                name,
                kit=kit,
                seconds=seconds,
                days=days,
                address=address,
                new=new,
                who=who,
                expected=expected,
            )
        case admin.HostRenew(name, text, days, expected):
            return await hosts.renew(name, text, days=days, who=who, expected=expected)
        case admin.HostRevoke(name, expected):
            return await hosts.revoke(name, who, expected)
        case admin.HostPorts(name, state, opened, checked, expected):
            when = time.time() if checked is None else checked
            return await hosts.ports.tell(name, state, opened, checked=when, who=who, expected=expected)
        case admin.HostsReload(expected):
            return await hosts.reload(who, expected)
