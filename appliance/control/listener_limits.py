"""Who is let in to the listeners of control, and under which limits: RVMaster's, the outer faces', the inner ones'.

A stranger (an address that no rule of the policy names) is refused by the beginning of its body, which says what was
asked for; while the real ROS Master is not hidden, everybody is refused.
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
from appliance.quotas.pool import Bounds, Standing
from appliance.quotas.table import RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_REQUESTS
from appliance.rpc.connection_table import Visitors
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import AtOnce, Handler, HttpServer, Peer, Refusal, not_at_once
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import Limits, build_fault


class Doors:
    """The limits and the visitors of all listeners; `policy()` is the one in force, `standing` says what hosts are."""

    def __init__(
        self,
        settings: Settings,
        trail: AuditTrail,
        policy: Callable[[], Policy],
        standing: Callable[[Address], Standing],
    ) -> None:
        limits = settings.limits
        self.http = HttpLimits(
            head_bytes=int(limits.header_bytes),
            head_seconds=limits.header_seconds,
            body_bytes=int(limits.body_bytes),
            idle_seconds=limits.idle_seconds,
        )
        self.visitors = Visitors(
            standing,
            connections=RVMASTER_CONNECTIONS.bounds.sized(
                connections_within(limits.connections), limits.connections_per_host
            ),
            standing_of_arrivals=partial(standing_of_arrival, policy, standing),
        )
        self.turns = Turns(RVMASTER_REQUESTS.bounds, standing, lambda host: policy().alike(host), trail.pause)
        self.time = ProcessorTime(partial(class_of, policy, standing))
        self._own_visitors = Visitors(_own_node, connections=_FOR_ONE, held=_BYTES_FOR_ONE)
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
        """Serve a listener; one that is not `guarded` is reached by the appliance's own processes only."""
        server = HttpServer(
            sock.dup(),
            handler,
            at_once=at_once,
            limits=self.http,
            visitors=self.visitors if guarded else self._own_visitors,
            turns=self.turns if guarded else self._own_turns,
            time=self.time,
            keep=keep,
            refuse=self.refuse if guarded else lambda _peer: None,
            troubled=self.troubled,
        )
        self._servers.append(server)
        await server.start()

    async def sweep(self) -> None:
        """Close the connections of all listeners whose time is over; runs until cancelled."""
        await asyncio.gather(self.visitors.sweep(), self._own_visitors.sweep())

    def close(self) -> None:
        """Serve nobody any more."""
        for server in self._servers:
            server.close()

    def refuse(self, peer: Peer) -> Refusal | None:
        """What answers somebody who is not to be served at all; None for the others."""
        if self._unhidden:
            fault = build_fault(1, f"the appliance does not serve: {self._unhidden}")
            return lambda _beginning: fault
        # The rosout aggregator calls from this machine, which the policy need not name; whoever does is decided by it.
        if peer.here or self._policy().knows(peer.host):
            return None
        return partial(self._refuse_stranger, peer)

    def _refuse_stranger(self, peer: Peer, beginning: bytes) -> bytes:
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
        """A peer went over a limit."""
        self._trail.happened("limit exceeded", reason, decision="deny", host=peer.text)

    def probed(self, reason: str) -> None:
        """The supervisor looked whether the ROS Master is hidden; `reason` is empty if it is."""
        if bool(reason) != bool(self._unhidden):
            event = "probe failed" if reason else "probe passed"
            self._trail.happened(event, reason or "the ROS Master is hidden")
        self._unhidden = reason


def value_limits(settings: Settings) -> Limits:
    """The bounds of XML-RPC values, as configured."""
    limits = settings.limits
    return Limits(
        body=int(limits.body_bytes),
        elements=limits.elements,
        depth=limits.nesting,
        string=int(limits.string_bytes),
        parts=limits.multicall_parts,
    )


_UNKNOWN, _ANYBODY = "unknown hosts", "hosts with a registration, by *"


def class_of(policy: Callable[[], Policy], standing: Callable[[Address], Standing], host: Address) -> str:
    """As whom a host has processor time: as the address or network that the policy names.

    Hosts that only `*` names are as many as somebody has addresses: all are one, and those that have a registration.
    """
    if host.is_loopback or policy().names(host):
        return policy().alike(host)
    return _ANYBODY if standing(host) is Standing.REGISTERED else _UNKNOWN


def standing_of_arrival(
    policy: Callable[[], Policy], standing: Callable[[Address], Standing], host: Address
) -> Standing:
    """Return a host's standing for connections that wait to be opened.

    Hosts that only `*` names and that have no registration count as strangers: all of them wait in one class of
    processor time, so their connections must not use the places of hosts that the policy names.
    """
    return Standing.STRANGER if class_of(policy, standing, host) == _UNKNOWN else standing(host)


# The appliance's own nodes and the ROS Master come from one address, and nobody else reaches those listeners.
_FOR_ONE, _BYTES_FOR_ONE, _SLOTS_FOR_ONE = (
    Bounds(whole=bounds.whole, host=bounds.whole, strangers=0, kept=0)
    for bounds in (RVMASTER_CONNECTIONS.bounds, RVMASTER_BYTES.bounds, RVMASTER_REQUESTS.bounds)
)


def _own_node(_host: Address) -> Standing:
    return Standing.REGISTERED
