"""Limit the listeners of control, and find the quota class of a host (`appliance/quotas`).

An unknown host (an address that no rule of the policy names, or that an operator blocks) is refused; if a section of
the policy is audit-only, only a blocked host is. The beginning of its body is read first, to record the name of the
call. While the ROS master is not hidden, every host is refused.
"""

import itertools
import socket
from collections.abc import Callable
from functools import partial

from appliance.audit.log.budget import THE_ROBOT, DiskGroup
from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.configuration.settings import Settings
from appliance.master.calls.call import with_record
from appliance.master.calls.request_peek import asked_for
from appliance.policy.host_sets import EVERYONE
from appliance.policy.model import Address, address_of, text_for_caller
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.quotas.descriptors import connections_within
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_REQUESTS
from appliance.rpc.acceptor import NamedFirst
from appliance.rpc.connection_table import ConnectionTable
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler, HttpRequest, HttpServer, Peer, Refusal, listen
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import XmlRpcLimits, build_fault


def open_listener(host: str, port: int) -> socket.socket:
    try:
        return listen(host, port)
    except OSError as error:
        raise OSError(
            f"{host}:{port} cannot be listened on: {error.strerror}; "
            "is a ROS master running there? Stop it, or choose another --listen"
        ) from error


class Answering:
    """Whether calls are answered; it counts those that are being carried out, so no host's queue matters."""

    def __init__(self) -> None:
        self._begun: dict[int, float] = {}  # oldest first
        self._numbers = itertools.count()
        self._answered = clock.now()

    def watch(self, handler: Handler) -> Handler:
        async def handle(request: HttpRequest) -> bytes:
            number = next(self._numbers)
            self._begun[number] = clock.now()
            try:
                return await handler(request)
            finally:
                del self._begun[number]
                self._answered = clock.now()

        return handle

    def overdue(self) -> float:
        """Return the seconds for which a call has waited while none was answered."""
        oldest = next(iter(self._begun.values()), None)
        return 0.0 if oldest is None else clock.now() - max(oldest, self._answered)


class ListenerLimits:
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
            connections=RVMASTER_CONNECTIONS.bounds.resize(
                connections_within(limits.connections), limits.connections_per_host
            ),
            connection_class=partial(connection_class_of, policy, quota_class),
        )
        alike = partial(class_of, policy, quota_class)
        self.turns = Turns(RVMASTER_REQUESTS.bounds, quota_class, alike, trail.pause, own_slots=True)
        self.time = ProcessorTime(alike)
        self.first = NamedFirst(policy)
        self.answering = Answering()
        self.own_connection_table = ConnectionTable(_own_node, connections=_FOR_ONE, held=_BYTES_FOR_ONE)
        self._own_turns = Turns(_SLOTS_FOR_ONE, _own_node)
        self._trail = trail
        self._policy = policy
        self._unhidden = ""
        self._servers: list[HttpServer] = []

    async def open(self, server: HttpServer) -> None:
        self._servers.append(server)
        await server.start()

    def server(
        self,
        sock: socket.socket,
        handler: Handler,
        *,
        guarded: bool = True,
        keep: bool = True,
    ) -> HttpServer:
        """Return a server; `guarded` is false for a listener that only the appliance's own processes can reach."""
        return HttpServer(
            sock,
            handler,
            limits=self.http,
            connection_table=self.connection_table if guarded else self.own_connection_table,
            turns=self.turns if guarded else self._own_turns,
            time=self.time,
            first=self.first if guarded else None,
            keep=keep,
            refuse=self.refuse if guarded else lambda _peer: None,
            troubled=self.troubled,
            malformed=self.malformed,
        )

    def close(self) -> None:
        for server in self._servers:
            server.close()

    def refuse(self, peer: Peer) -> Refusal | None:
        if self._unhidden:
            fault = build_fault(1, f"the appliance does not serve nodes: {self._unhidden}")
            return lambda _beginning: fault
        policy = self._policy()
        # The rosout aggregator calls from this machine. The policy need not name this machine.
        if peer.here or policy.serves(peer.host):
            return None
        denial = policy.block_of(peer.host)
        reason = policy.why_unnamed(peer.host) if denial is None else denial.reason
        told = reason if denial is None else text_for_caller(denial, policy.tell)
        return partial(self._refuse_unknown, peer, reason, told)

    def _refuse_unknown(self, peer: Peer, reason: str, told: str, beginning: bytes) -> bytes:
        asked = asked_for(peer, beginning)
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
        return build_fault(1, with_record(told, record))

    def troubled(self, peer: Peer, reason: str) -> None:
        self._trail.happened("limit exceeded", reason, decision="deny", host=peer.text)

    def malformed(self, peer: Peer, reason: str) -> None:
        self._trail.happened("malformed", reason, decision="deny", host=peer.text)

    def probed(self, reason: str) -> None:
        if bool(reason) != bool(self._unhidden):
            event = "probe failed" if reason else "probe passed"
            self._trail.happened(event, reason or "the ROS master is hidden")
        self._unhidden = reason


def value_limits(settings: Settings) -> XmlRpcLimits:
    limits = settings.limits
    return XmlRpcLimits(
        body=int(limits.body_bytes),
        elements=limits.elements,
        depth=limits.nesting,
        string=int(limits.string_bytes),
        parts=limits.multicall_parts,
    )


_UNKNOWN, _ANYBODY = "unknown hosts", "hosts with a registration, by *"


def class_of(
    policy: Callable[[], Policy], quota_class: Callable[[Address], QuotaClass], host: Address
) -> str:
    """Return the class that is charged for a host's processor time, and that shares turns.

    A host can have many addresses. So all hosts that only `*` names share one class, and those of them with a
    registration another.
    """
    standing = policy().standing(host)
    if host.is_loopback or standing.named:
        return standing.alike
    return _ANYBODY if quota_class(host) is QuotaClass.REGISTERED else _UNKNOWN


def connection_class_of(
    policy: Callable[[], Policy], quota_class: Callable[[Address], QuotaClass], host: Address
) -> QuotaClass:
    """Return a host's quota class for connections.

    Hosts that only `*` names must not use up the quotas of named hosts: with a registration, which each of them can
    make, they count as named, otherwise as unknown.
    """
    if host.is_loopback or policy().standing(host).named:
        return quota_class(host)
    return QuotaClass.NAMED if quota_class(host) is QuotaClass.REGISTERED else QuotaClass.UNKNOWN


# The bounds for the appliance's own nodes and the ROS master: they share one address, and no other host can reach their
# listeners.
_FOR_ONE, _BYTES_FOR_ONE, _SLOTS_FOR_ONE = (
    Bounds(whole=bounds.whole, host=bounds.whole, unknown=0, kept=0)
    for bounds in (RVMASTER_CONNECTIONS.bounds, RVMASTER_BYTES.bounds, RVMASTER_REQUESTS.bounds)
)


def _own_node(_host: Address) -> QuotaClass:
    return QuotaClass.REGISTERED


class HostQuotaClass:
    """The quota class of hosts, by the policy in force and by their registrations."""

    def __init__(self, policy: CurrentPolicy, registrations: Callable[[Address], int]) -> None:
        self._policy = policy
        self._registrations = registrations

    def __call__(self, host: Address) -> QuotaClass:
        """Return the quota class of a host; in audit-only mode, even an unknown host can have registrations.

        Before the first policy, every host counts as named.
        """
        if not self._policy:
            return QuotaClass.NAMED
        # The policy need not name loopback, from which the appliance's own nodes call.
        if not (host.is_loopback or self._policy().standing(host).known):
            return QuotaClass.UNKNOWN
        return QuotaClass.REGISTERED if self._registrations(host) else QuotaClass.NAMED

    def of_text(self, host: str) -> QuotaClass:
        """Return the quota class of a host in text form; a text that is not an address counts as named."""
        try:
            return self(address_of(host))
        except ValueError:
            return QuotaClass.NAMED

    def disk_group(self, host: str) -> DiskGroup | None:
        """Return the hosts with which a host shares its part of the audit log's disk, and the last of its reserve.

        Only the robot and hosts that the policy names by address or network have a part. If a policy names only `*`,
        each host with a registration has one.
        """
        try:
            address = address_of(host)
        except ValueError:
            return None
        if not self._policy:
            return None
        policy = self._policy()
        if address.is_loopback or any(address in network for network in policy.robot):
            return None if policy.block_of(address) is not None else THE_ROBOT
        if policy.named <= {EVERYONE}:
            return DiskGroup(host) if self(address) is QuotaClass.REGISTERED else None
        return DiskGroup(policy.alike(address)) if policy.names(address) else None
