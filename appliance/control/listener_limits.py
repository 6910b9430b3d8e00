"""The limits of control's listeners, and the hosts that they serve: RVMaster's, peer-side and master-side endpoints.

An unknown host (an address that no rule of the policy names) is refused after the beginning of its body, which names
the call. While the ROS master is not hidden, every host is refused.
"""

import asyncio
import socket
from collections.abc import Callable
from functools import partial

from appliance.audit.record import Severity
from appliance.configuration.settings import Settings
from appliance.master.calls.call import with_record
from appliance.master.calls.request_peek import asked_for
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.quotas.descriptors import connections_within
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_REQUESTS
from appliance.rpc.connection_table import ConnectionTable
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import AtOnce, Handler, HttpServer, Peer, Refusal, not_at_once
from appliance.rpc.source_queues import NamedFirst
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import XmlRpcLimits, build_fault


class ListenerLimits:
    """The limits and connections of all listeners; `policy()` is in force, `quota_class` classifies hosts."""

    def __init__(
        self,
        settings: Settings,
        trail: AuditTrail,
        policy: Callable[[], Policy],
        quota_class: Callable[[Address], QuotaClass],
    ) -> None:
        limits = settings.limits
        self.http = HttpLimits(
            head_bytes=int(limits.header_bytes),
            head_seconds=limits.header_seconds,
            body_bytes=int(limits.body_bytes),
            idle_seconds=limits.idle_seconds,
        )
        self.connection_table = ConnectionTable(
            quota_class,
            connections=RVMASTER_CONNECTIONS.bounds.sized(
                connections_within(limits.connections), limits.connections_per_host
            ),
            connection_class=partial(connection_class_of, policy, quota_class),
        )
        self.turns = Turns(
            RVMASTER_REQUESTS.bounds, quota_class, lambda host: policy().alike(host), trail.pause
        )
        self.time = ProcessorTime(partial(class_of, policy, quota_class))
        self.first = NamedFirst(policy)
        self._own_connection_table = ConnectionTable(_own_node, connections=_FOR_ONE, held=_BYTES_FOR_ONE)
        self._own_turns = Turns(_SLOTS_FOR_ONE, _own_node)
        self._trail = trail
        self._policy = policy
        self._unhidden = ""
        self._servers: list[HttpServer] = []

    async def open(
        self,
        sock: socket.socket,
        handler: Handler,
        *,
        guarded: bool,
        at_once: AtOnce = not_at_once,
        keep: bool = True,
    ) -> None:
        """Serve a listener. Without `guarded`, only the appliance's own processes can reach it."""
        server = self.server(sock.dup(), handler, guarded=guarded, at_once=at_once, keep=keep)
        self._servers.append(server)
        await server.start()

    def server(
        self,
        sock: socket.socket,
        handler: Handler,
        *,
        guarded: bool = True,
        at_once: AtOnce = not_at_once,
        keep: bool = True,
    ) -> HttpServer:
        """Return a server that shares the limits of all listeners; the caller starts and closes it."""
        return HttpServer(
            sock,
            handler,
            at_once=at_once,
            limits=self.http,
            connection_table=self.connection_table if guarded else self._own_connection_table,
            turns=self.turns if guarded else self._own_turns,
            time=self.time,
            first=self.first if guarded else None,
            keep=keep,
            refuse=self.refuse if guarded else lambda _peer: None,
            troubled=self.troubled,
        )

    async def sweep(self) -> None:
        """Close expired connections of all listeners; runs until cancelled."""
        await asyncio.gather(self.connection_table.sweep(), self._own_connection_table.sweep())

    def close(self) -> None:
        """Stop serving."""
        for server in self._servers:
            server.close()

    def refuse(self, peer: Peer) -> Refusal | None:
        """Return the refusal for a peer that is not served, or None."""
        if self._unhidden:
            fault = build_fault(1, f"the appliance does not serve nodes: {self._unhidden}")
            return lambda _beginning: fault
        # The rosout aggregator calls from this machine, which the policy need not name.
        if peer.here or self._policy().knows(peer.host):
            return None
        return partial(self._refuse_unknown, peer)

    def _refuse_unknown(self, peer: Peer, beginning: bytes) -> bytes:
        asked = asked_for(peer, beginning)
        reason = f"no rule of the policy names {peer.text}"
        record = self._trail.happened(
            "decision",
            reason,
            severity=Severity.WARNING,
            decision="deny",
            host=peer.text,
            caller_id=asked.caller_id,
            category=asked.category.value,
            resource=asked.resource,
            more=asked.about,
        )
        return build_fault(1, with_record(reason, record))

    def troubled(self, peer: Peer, reason: str) -> None:
        """Record that a peer exceeded a limit."""
        self._trail.happened("limit exceeded", reason, decision="deny", host=peer.text)

    def probed(self, reason: str) -> None:
        """Handle the supervisor's probe of whether the ROS master is hidden; `reason` is empty if it is."""
        if bool(reason) != bool(self._unhidden):
            event = "probe failed" if reason else "probe passed"
            self._trail.happened(event, reason or "the ROS master is hidden")
        self._unhidden = reason


def value_limits(settings: Settings) -> XmlRpcLimits:
    """Return the configured bounds of XML-RPC values."""
    limits = settings.limits
    return XmlRpcLimits(
        body=int(limits.body_bytes),
        elements=limits.elements,
        depth=limits.nesting,
        string=int(limits.string_bytes),
        parts=limits.multicall_parts,
    )


ClassOf = Callable[[Address], QuotaClass]
_UNKNOWN, _ANYBODY = "unknown hosts", "hosts with a registration, by *"


def class_of(policy: Callable[[], Policy], quota_class: ClassOf, host: Address) -> str:
    """Return the class that is charged for a host's processor time: the address or network that the policy names.

    Hosts can have many addresses: all that only `*` names are one class, and those with a registration another.
    """
    if host.is_loopback or policy().names(host):
        return policy().alike(host)
    return _ANYBODY if quota_class(host) is QuotaClass.REGISTERED else _UNKNOWN


def connection_class_of(policy: Callable[[], Policy], quota_class: ClassOf, host: Address) -> QuotaClass:
    """Return a host's quota class for connections.

    Hosts that only `*` names share processor time as one host, so their connections must not use the quotas of hosts
    that the policy names. Without a registration they count as unknown, and with one as named: any host that `*` names
    can register a node, so the part for registered hosts is kept for those that the policy names.
    """
    found = class_of(policy, quota_class, host)
    if found == _UNKNOWN:
        return QuotaClass.UNKNOWN
    return QuotaClass.NAMED if found == _ANYBODY else quota_class(host)


# The appliance's own nodes and the ROS master share one address, and other hosts cannot reach their listeners.
_FOR_ONE, _BYTES_FOR_ONE, _SLOTS_FOR_ONE = (
    Bounds(whole=bounds.whole, host=bounds.whole, unknown=0, kept=0)
    for bounds in (RVMASTER_CONNECTIONS.bounds, RVMASTER_BYTES.bounds, RVMASTER_REQUESTS.bounds)
)


def _own_node(_host: Address) -> QuotaClass:
    return QuotaClass.REGISTERED
