"""Show operators the hosts, their differences from hosts.yaml, and what needs attention."""

import math
from collections.abc import Mapping
from typing import cast

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.answers.host_answers import Host, PortsSeen, PortsState, State
from appliance.channel.answers.status import IpsecState
from appliance.features.tunnels.enrolment_tokens import EnrolmentTokens
from appliance.features.tunnels.tunnel_answers import Machine
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.policy.host_names import HostInWords
from appliance.store.host_tables import EnrolmentTokenRow, HostRow

_CLOCKS_DIFFER = 3600.0  # a certificate begins this long before it is made
SOON_SECONDS = 14 * 86_400.0
_NEVER = PortsSeen("unknown", None, [], "")


def soon(table: HostTable, row: HostRow, now: float) -> bool:
    """Return whether a certificate ends within 14 days, or a third of its life if that is shorter, and has not yet."""
    certificate = table.certificates.get(row.name)
    life = row.expires - certificate.made if certificate is not None else SOON_SECONDS * 3
    return 0 < row.expires - now < min(SOON_SECONDS, life / 3)


def ending(table: HostTable, row: HostRow, now: float) -> str:
    """Return in words that the certificate has ended, or ends soon; "" if neither."""
    if soon(table, row, now):
        return with_remedy(row, f"expires in {span(row.expires - now)} and was not renewed")
    return with_remedy(row, "has expired") if row.expires <= now else ""


def with_remedy(row: HostRow, why: str) -> str:
    return f"the certificate of {row.name} {why}: rosrv host kit {row.name}"


def outside_the_pool(table: HostTable, row: HostRow) -> str:
    return (
        f"{row.name} has {row.address}, outside ipsec.pool ({table.pool}), and cannot connect:"
        f" rosrv host kit {row.name} gives it another address"
    )


class HostView:
    """Shows the hosts; `machines` counts, by address, nodes that use no tunnel."""

    def __init__(
        self, table: HostTable, awaited: EnrolmentTokens, tunnels: Tunnels, in_words: HostInWords
    ) -> None:
        self._table = table
        self._awaited = awaited
        self._tunnels = tunnels
        self._in_words = in_words

    def rows(self) -> list[Host]:
        awaited = self._awaited.rows()
        names = {*self._table.rows, *self._table.declared.hosts, *awaited}
        return [self._row(name, awaited.get(name)) for name in sorted(names)]

    def _row(self, name: str, awaited: EnrolmentTokenRow | None) -> Host:
        declared = self._table.declared.hosts.get(name)
        row, seen = self._table.rows.get(name), self._tunnels.seen.get(name)
        promised = awaited.address if awaited else declared.address if declared else None
        certificate = self._table.certificates.get(name)
        now = clock.wall()
        return Host(
            name=name,
            address=row.address if row else promised,
            state=self._state(name, row, now, awaited=awaited is not None),
            groups=list(declared.groups) if declared else [],
            declared=declared is not None,
            wanted=self._table.declared.wants(name),
            divergence=self.divergence(name),
            serial=row.serial if row else None,
            enrolled=row.enrolled if row else None,
            expires=row.expires if row else None,
            expires_soon=row is not None and row.revoked is None and soon(self._table, row, now),
            renewing=certificate is not None and certificate.next is not None,
            revoked=row.revoked if row else None,
            remote=seen.remote if seen else None,
            seconds=seen.seconds if seen else None,
            bytes_in=seen.bytes_in if seen else None,
            bytes_out=seen.bytes_out if seen else None,
            last_seen=self._tunnels.last.get(name),
            token_expires=awaited.expires if awaited else None,
            token_by=awaited.who if awaited else "",
            ports=self.ports(name),
        )

    def divergence(self, name: str) -> str | None:
        if not self._table.declared.there:
            return None
        declared, row = self._table.declared.hosts.get(name), self._table.rows.get(name)
        if declared is None:
            return "enrolled, not in hosts.yaml" if row is not None and row.revoked is None else None
        if row is None:
            return "in hosts.yaml, not enrolled"
        if row.revoked is not None:
            return "in hosts.yaml, revoked"
        keeps = self._table.is_for_hosts(row.address)
        if keeps and declared.address is not None and declared.address != row.address:
            return f"hosts.yaml declares {declared.address}; it keeps {row.address} permanently"
        return None

    def ports(self, name: str) -> PortsSeen:
        row = self._table.ports.get(name)
        if row is None:
            return _NEVER
        return PortsSeen(cast(PortsState, row.state), row.checked, row.open, row.who)

    def status(self, machines: Mapping[str, int]) -> IpsecState:
        charon, troubles = self._tunnels.charon, {**self._troubles(), **self._open_ports()}
        return IpsecState(
            esp=self._tunnels.esp,
            key_exchange=charon.key_exchange if charon else [],
            post_quantum=any("mlkem" in exchange for exchange in charon.key_exchange) if charon else None,
            charon=charon.version if charon else None,
            pool=str(self._table.pool),
            address=self._table.own_address,
            hosts_file=str(self._table.declared.path),
            enrolled=len(self._table.hosts()),
            awaited=len(self._awaited.rows()),
            up=len(self._tunnels.seen),
            troubles=[*troubles.values()],
            ports=self._known_ports(machines),
            trouble_names=[*troubles],
        )

    def machines(self, machines: Mapping[str, int]) -> list[Machine]:
        told = self._table.ports.keys() - self._table.rows.keys() - self._table.declared.hosts.keys()
        return [
            Machine(address, machines.get(address, 0), self.ports(address))
            for address in sorted({*machines, *told})
        ]

    def _known_ports(self, machines: Mapping[str, int]) -> dict[str, PortsSeen]:
        return {name: self.ports(name) for name in [*(row.name for row in self._table.hosts()), *machines]}

    def _open_ports(self) -> dict[str, str]:
        return {
            f"{name}:ports": f"ROS ports of {self._in_words(name)} are open to hosts other than the appliance"
            f" (checked by {row.who}): run rosrv protect there"
            for name, row in self._table.ports.items()
            if row.state == "open" and not ((host := self._table.rows.get(name)) and host.revoked is not None)
        }

    def _state(self, name: str, row: HostRow | None, now: float, *, awaited: bool) -> State:
        if row is None:
            return "awaited" if awaited else "not enrolled"
        if row.revoked is not None:
            return "awaited" if awaited else "revoked"
        if not self._table.declared.wants(name):
            return "not wanted"
        if name in self._tunnels.seen:
            return "up"
        return "expired" if row.expires <= now else "down"

    def _troubles(self) -> dict[str, str]:
        now, found = clock.wall(), dict[str, str]()
        if self._table.admitted_hosts() and not self._tunnels.enclosed:
            found["firewall"] = f"enrolled hosts cannot connect: {self._tunnels.obstacle}"
        for row in self._table.hosts():
            if not self._table.is_for_hosts(row.address):
                found[f"{row.name}:pool"] = outside_the_pool(self._table, row)
            certificate = self._table.certificates.get(row.name)
            if certificate is not None and certificate.made > now + _CLOCKS_DIFFER:
                text = with_remedy(row, "was made while the clock was ahead, and is not valid yet")
            else:
                text = ending(self._table, row, now)
            if text:
                found[f"{row.name}:certificate"] = text
        missing = self._table.missing_as_revoked()
        if missing:
            found["revoked"] = (
                f"the list of revoked certificates is full: {missing} are not on it, and they can still open"
                " their hosts' tunnels until they expire"
            )
        if self._table.declared.error:
            found["hosts.yaml"] = self._table.declared.error
        if self._tunnels.waits:
            found["address"] = self._tunnels.waits
        return found


def span(seconds: float) -> str:
    if seconds >= 2 * 86_400:
        return f"{int(seconds // 86_400)} days"
    if seconds >= 7200:
        return f"{int(seconds // 3600)} hours"
    return f"{int(seconds // 60)} minutes" if seconds >= 120 else counted(math.ceil(seconds), "second")
