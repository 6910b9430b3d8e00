"""Carry out the calls that register and unregister topics, services, and subscriptions to parameters.

Each change is stored before it is answered, because a ROS 1 node never registers twice. `Arrivals` finds or makes the
incarnation of a registering call, by its name, host and API URI.

A URI may name another host than the caller's address: another address of its machine, or one behind NAT, as in a
container. The caller's address counts. If the node's port is not open there, as every node's port is before it
registers, no node can call it. It may subscribe and call services, but not publish or offer a service, except
what the client libraries register for every node: that is answered, and not registered.

multimaster_fkie registers the nodes of other machines, in multicalls, which no client library uses to register. Such
nodes are refused, because they would be subscribers that never connect.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.master.calls.call import ApiUri, Attempt, Caller, NotServedError
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.endpoints.node_ports import AdvertisedAddresses, NodePorts, NoPortError
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry, new_key
from appliance.master.reconcile.liveness import Liveness
from appliance.master.reconcile.sinks import ProxyEndpoints
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import Answer
from appliance.policy.model import Address
from appliance.rpc.server import Handler

_CONNECT_SECONDS = 1.0
_PATIENT_SECONDS = 3.0  # also after the loss of a packet
_AGAIN_SECONDS = 0.3
_AWAY_SECONDS = 600.0  # after which a lost node makes room for those of other hosts: it may be away for a day

_NOT_REGISTERED = "Because this node cannot be called"

ServeNode = Callable[[Incarnation], Handler]
"""Makes the handler of a node's proxy endpoint."""


class NodeElsewhereError(NotServedError):
    """The registered node does not run on the caller's host; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Finds or makes the incarnations of callers."""

    registry: Registry
    graph: RosGraph
    flush: Callable[[], None]
    liveness: Liveness
    places: NodePorts
    faces: ProxyEndpoints
    addresses: AdvertisedAddresses
    serve: ServeNode

    def known_node(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        return self.registry.find(caller.caller_id, caller.peer.host, api.text)

    async def incarnation_for(self, caller: Caller, api: ApiUri) -> Incarnation:
        """Return the calling incarnation; an unknown caller gets a new one with ports.

        Raises `HostFullError`, `NoPortError`, or `NodeElsewhereError`; then no incarnation is made.
        """
        identity = (caller.caller_id, caller.peer.host, api.text)
        incarnation = self.registry.find(*identity)
        if incarnation is not None and incarnation.life is Life.SHADOW:
            if self.registry.holder(incarnation.name) is None:
                self.liveness.revive(incarnation)  # before a check has found that the node is back
            else:  # another incarnation took the name in the meantime, so this node starts as a new incarnation
                self.graph.forgotten(incarnation)
        if incarnation is not None and incarnation.life is Life.LIVE:
            incarnation.touched = clock.now()
            self.registry.reached_at(incarnation, self.addresses.address_for(caller.peer))
            return incarnation
        incarnation = self._make(caller, api)
        incarnation.calls += 1
        try:
            await self.faces.open(incarnation, self.serve(incarnation))
            await self._check_place(caller, incarnation)
        except (NoPortError, NodeElsewhereError):
            self.graph.forgotten(incarnation)
            raise
        finally:
            incarnation.calls -= 1
        return incarnation

    async def callable_for(self, caller: Caller, api: ApiUri, resource: str) -> Incarnation | None:
        """Return the incarnation like `incarnation_for`, for a topic or service for which other nodes call it.

        Return None for what every node registers, if it cannot be called. Also raises `NodeElsewhereError` for others.
        """
        incarnation = await self.incarnation_for(caller, api)
        if incarnation.reached is not False:
            return incarnation
        if incarnation.offered_by_every(resource):
            return None
        if await self._opens(incarnation):
            self.liveness.reached(incarnation)
            self.liveness.look_at(incarnation)
            return incarnation
        if incarnation.evictable:
            self.graph.forgotten(incarnation)
        raise NodeElsewhereError(
            f"{self._elsewhere(caller, incarnation)}, so it can only subscribe and call services. To publish or offer "
            f"a service, admit {incarnation.told} in that machine's firewall; behind NAT, as in a container's own "
            "network, run the node with the host's network (docker run --network host), or publish its ports and set "
            f"ROS_IP={caller.peer.text}, or use a tunnel (rosrv host add)"
        )

    async def _opens(self, incarnation: Incarnation) -> bool:
        """Return whether the node's port is open; a program may begin to listen a moment after it registers."""
        client, end = self.liveness.nodes.client(incarnation), clock.now() + _PATIENT_SECONDS
        while (left := end - clock.now()) > 0:
            if await client.reaches(left):
                return True
            await asyncio.sleep(_AGAIN_SECONDS)
        return False

    async def _check_place(self, caller: Caller, incarnation: Incarnation) -> None:
        if caller.own or incarnation.api.host == caller.peer.text:
            return
        if await self.liveness.nodes.client(incarnation).reaches(_CONNECT_SECONDS):
            return
        if caller.in_multicall:
            raise NodeElsewhereError(
                f"{self._elsewhere(caller, incarnation)}: nodes of other masters (multimaster_fkie) cannot be "
                "registered here: start them with this master's ROS_MASTER_URI"
            )
        incarnation.reached = False

    def _elsewhere(self, caller: Caller, incarnation: Incarnation) -> str:
        six = caller.peer.host.version == 6
        hint = " (set ROS_IPV6=on, or use an IPv4 address of the master)" if six else ""
        return (
            f"{caller.peer.text} registers {caller.caller_id} at {incarnation.api_text[:80]}, but {incarnation.told} "
            f"(the appliance) cannot connect to port {incarnation.api.port} of {caller.peer.text}{hint}"
        )

    def _make(self, caller: Caller, api: ApiUri) -> Incarnation:
        identity = (caller.caller_id, caller.peer.host, api.text)
        if not caller.own and (evicted := self.registry.room_for(*identity)) is not None:
            self.graph.forgotten(evicted)
        outer_port, relay_port, *more = self._open_ports(caller.peer.host)
        incarnation = Incarnation(
            key=new_key(),
            name=caller.caller_id,
            host=caller.peer.host,
            api=api.uri,
            api_text=api.text,
            told=self.addresses.address_for(caller.peer),
            outer_port=outer_port,
            relay_port=relay_port,
            more_relay_ports=tuple(more),
            own=caller.own,
            changed=clock.now(),
            touched=clock.now(),
        )
        self.registry.add(incarnation)
        return incarnation

    def _open_ports(self, host: Address) -> tuple[int, ...]:
        while True:
            self.flush()  # closes the ports of forgotten nodes
            try:
                return self.places.open(host)
            except NoPortError:
                evicted = self.registry.evictable_for(host, lost_before=clock.now() - _AWAY_SECONDS)
                if evicted is None:
                    raise
                self.graph.forgotten(evicted)


@dataclass(frozen=True, slots=True)
class RegistrationCalls:
    """Changes the graph by the calls of nodes, and answers them."""

    registry: Registry
    graph: RosGraph
    arrivals: Arrivals
    relay: RelayControl
    parameters: ParameterCalls
    subscribers: Subscribers

    async def register_publisher(
        self, caller: Caller, topic: str, topic_type: str, caller_api: ApiUri
    ) -> Answer:
        """`registerPublisher(caller_id, topic, topic_type, caller_api)` → the subscribers' (outer) URIs."""
        node = await self.arrivals.callable_for(caller, caller_api, topic)
        if node is None:
            return [1, f"{_NOT_REGISTERED}, [{topic}] is not registered", []]
        self.graph.registered(node, Kind.PUBLICATION, topic, topic_type)
        hidden = self.relay.hides_publishers(topic)
        subscribers = self.registry.uris_for(node, Kind.SUBSCRIPTION, topic, hidden=hidden)
        return [1, f"Registered [{node.name}] as publisher of [{topic}]", list(subscribers)]

    async def register_subscriber(
        self, caller: Caller, topic: str, topic_type: str, caller_api: ApiUri
    ) -> Answer:
        """`registerSubscriber(caller_id, topic, topic_type, caller_api)` → the publishers' (outer) URIs."""
        node = await self.arrivals.incarnation_for(caller, caller_api)
        self.graph.registered(node, Kind.SUBSCRIPTION, topic, topic_type)
        return [1, f"Subscribed to [{topic}]", list(self.subscribers.list_for(node, topic))]

    async def register_service(
        self, caller: Caller, service: str, service_api: ApiUri, caller_api: ApiUri
    ) -> Answer:
        """`registerService(caller_id, service, service_api, caller_api)`."""
        node = await self.arrivals.callable_for(caller, caller_api, service)
        if node is None:
            return [1, f"{_NOT_REGISTERED}, [{service}] is not registered", 1]
        port = str(service_api.uri.port)
        self.graph.registered(node, Kind.SERVICE, service, port)
        return [1, f"Registered [{node.name}] as provider of [{service}]", 1]

    async def subscribe_param(self, caller: Caller, caller_api: ApiUri, key: str) -> Answer:
        """`subscribeParam(caller_id, caller_api, key)`."""
        read = await self.parameters.read(caller, key)
        hidden = self.parameters.rights.denial_to_read(caller, "subscribeParam", key, read)
        if hidden is not None:
            return [0, hidden, 0]
        if read[0] == 0:  # the ROS master failed
            return read
        node = await self.arrivals.incarnation_for(caller, caller_api)
        self.graph.registered(node, Kind.PARAMETER, key, "")
        self.subscribers.value_given(node, key)
        return [1, f"Subscribed to parameter [{key}]", read[2] if read[0] == 1 else {}]

    async def unregister_publisher(self, caller: Caller, topic: str, caller_api: ApiUri) -> Answer:
        """`unregisterPublisher(caller_id, topic, caller_api)`."""
        return await self._unregister_topic(caller, Kind.PUBLICATION, topic, caller_api)

    async def unregister_subscriber(self, caller: Caller, topic: str, caller_api: ApiUri) -> Answer:
        """`unregisterSubscriber(caller_id, topic, caller_api)`."""
        return await self._unregister_topic(caller, Kind.SUBSCRIPTION, topic, caller_api)

    async def unregister_service(self, caller: Caller, service: str, service_api: ApiUri) -> Answer:
        """`unregisterService(caller_id, service, service_api)`: the node is found by its service."""
        port = service_api.uri.port
        provider = next(
            (
                holder
                for holder in self.registry.registrants(Kind.SERVICE, service)
                if holder.name == caller.caller_id
                # The URI has the node's own port, or the port that lookupService returned (`rosnode cleanup`).
                and (
                    holder.registrations[Kind.SERVICE, service].detail == str(port)
                    or self.relay.port(holder, Kind.SERVICE, service) == port
                )
            ),
            None,
        )
        other = f"[{service_api.text}] is no longer the current service api handle for [{service}]"
        return self._unregister(caller, provider, Kind.SERVICE, service, other)

    async def unsubscribe_param(self, caller: Caller, caller_api: ApiUri, key: str) -> Answer:
        """`unsubscribeParam(caller_id, caller_api, key)`, with the ROS master's constant answer."""
        self._unregister(caller, self.arrivals.known_node(caller, caller_api), Kind.PARAMETER, key, "")
        return [1, f"Unsubscribe to parameter [{key}]", 1]

    async def _unregister_topic(self, caller: Caller, kind: Kind, topic: str, caller_api: ApiUri) -> Answer:
        node = self.arrivals.known_node(caller, caller_api) or self._by_lookup_uri(caller, caller_api)
        other = f"[{caller.caller_id}] is not a known provider of [{topic}]"
        return self._unregister(caller, node, kind, topic, other)

    def _unregister(
        self, caller: Caller, node: Incarnation | None, kind: Kind, resource: str, other: str
    ) -> Answer:
        name = caller.caller_id
        if self.registry.holder(name) is None:
            answer: Answer = [1, f"[{name}] is not a registered node", 0]
        elif node is None or node.life is not Life.LIVE or (kind, resource) not in node.registrations:
            answer = [1, other, 0]
        else:
            answer = [1, f"Unregistered [{name}] as provider of [{resource}]", 1]
        if node is not None:
            self.graph.unregistered(node, kind, resource)
        return answer

    def _by_lookup_uri(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """Return the node of a lookupNode URI, as `rosnode cleanup` on the node's host sends it."""
        holder = self.registry.holder(caller.caller_id)
        meant = holder is not None and (holder.host, holder.outer_port) == (caller.peer.host, api.uri.port)
        return holder if meant else None


def given_up(registry: Registry, denied: Attempt) -> None:
    """Forget a registration that the policy withdrew, because its node unregisters it, even if that call is denied."""
    kind, caller = denied.call.kind, denied.caller
    asked = next(argument for argument in denied.arguments if isinstance(argument, ApiUri))
    for incarnation in registry.all():
        shelved = None if kind is None else incarnation.shelf.get((kind, denied.resource))
        if shelved is None or (incarnation.name, incarnation.host) != (caller.caller_id, caller.peer.host):
            continue
        by_port = shelved.kind is Kind.SERVICE and shelved.detail == str(asked.uri.port)
        if by_port or incarnation.api_text == asked.text:
            registry.unshelve(incarnation, shelved.kind, shelved.resource)
