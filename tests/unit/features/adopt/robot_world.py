"""A robot of scripted nodes with a scripted master, beside RVMaster's own parts: no socket, no clock.

A `KilledError` ends an operation after a step, as a kill of control does: the registry stays, because control stores
it; all that the operation knew is lost, and the next control sends each subscriber its own list first.

Subscribers are those of roscpp, see `RobotNode.take_list`.
"""

import asyncio
import copy
import ipaddress
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from appliance.features.adopt.adopt_record import AdoptRecord, Phase
from appliance.features.adopt.control_part import ParameterOrders
from appliance.features.adopt.graph_side import AdoptedGraph
from appliance.features.adopt.machine_facts import MachineFacts, RobotMaster
from appliance.features.adopt.takeover import AdoptError, AdoptOperation, LeftThere
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterRights
from appliance.master.graph.registry import Incarnation
from appliance.policy.model import Address
from appliance.rpc.master_reader import Entry, MasterCall, MasterGraph, MasterReadError
from appliance.rpc.xmlrpc_client import CallFailedError, UnansweredError
from roswire.errors import EncodingError
from roswire.uris import NodeUri
from roswire.xmlrpc import Value
from tests.support.control_parts import ControlParts, Told
from tests.support.engines import KilledError

LINK = "10.111.0.1"
_NODE_SECONDS = 2.0
_KINDS = {"Publisher": "publication", "Subscriber": "subscription", "Service": "service"}


@dataclass
class RobotNode:
    name: str
    uri: str
    port: int
    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    alive: bool = True
    lists: dict[str, list[str]] = field(default_factory=dict)
    """The last list of publishers of each topic."""
    earlier: list[tuple[str, list[str]]] = field(default_factory=list)
    """All lists that came by calls of the operation."""
    fails: int = 0
    """Lists after which the node does not connect, because its call to a publisher fails."""
    hangs: bool = False
    held: list[tuple[str, list[str]]] = field(default_factory=list)
    """The lists that wait for a node that hangs: its kernel has taken them."""
    keeps: bool = False
    """As in rospy, a list ends no connection."""
    slow: bool = False
    """It is still connecting when the next list comes."""
    links: dict[str, dict[str, bool]] = field(default_factory=dict)
    """By topic and publisher, whether the connection stands."""
    begun: list[tuple[str, str]] = field(default_factory=list)
    """The connections that it makes later."""
    most: dict[str, int] = field(default_factory=dict)
    """The most connections that a topic had at once."""
    tells: str = "port"
    """The answer to `requestTopic`: `port`, `refusal` to a topic that it does not publish, or `nothing`."""
    lags: int = 0
    """The number of looks after a cut for which it still reads, and lists, a connection that was cut."""
    reads_on: dict[str, int] = field(default_factory=dict)
    """The looks that are left, by the topic of such a connection."""
    heard_both: set[str] = field(default_factory=set)
    """Topics that it got a new publisher for while it still read."""

    @property
    def connected(self) -> dict[str, list[str]]:
        return {
            topic: [uri for uri, stands in links.items() if stands] for topic, links in self.links.items()
        }

    def take_list(self, topic: str, uris: list[str]) -> None:
        """Connect as roscpp does: it neither drops a connection that it is making, nor repeats one that has ended."""
        links = self.links.setdefault(topic, {})
        for uri in [uri for uri in links if not links[uri]] if self.keeps else links.keys() - {*uris}:
            del links[uri]
        added = [
            uri for uri in uris if uri not in links and uri != self.uri and (topic, uri) not in self.begun
        ]
        if self.fails and added:
            self.fails -= 1
        else:
            self.begun += [(topic, uri) for uri in added]

    def connect(self, reaches: Callable[[str], bool]) -> None:
        for topic, uri in self.begun:
            if reaches(uri):
                self.links.setdefault(topic, {})[uri] = True
        self.begun.clear()
        self.most = {topic: max(len(uris), self.most.get(topic, 0)) for topic, uris in self.connected.items()}

    def entries(self) -> set[Entry]:
        return {
            *(("publication", topic, self.name) for topic in self.publishes),
            *(("subscription", topic, self.name) for topic in self.subscribes),
            *(("service", service, self.name) for service in self.services),
        }


class ScriptedReader:
    """The robot's own master. `before` is called before each reading and each written call."""

    def __init__(self) -> None:
        self.entries: set[Entry] = set()
        self.nodes: dict[str, str] = {}
        self.services: dict[str, str] = {}
        self.tree: dict[str, Value] = {"run_id": "robot", "speed": 1.5}
        self.shutdowns: list[str] = []
        self.before: Callable[[], None] = lambda: None
        self.calls_until_kill = 0
        self.alive = True
        self.uri = NodeUri("http", LINK, 11311, "/")

    def _require(self) -> None:
        self.before()
        if not self.alive:
            raise MasterReadError("nobody answers")

    async def read(self) -> MasterGraph:
        self._require()
        types = {topic: "std_msgs/String" for kind, topic, _name in self.entries if kind != "service"}
        nodes = {
            name: uri for name, uri in self.nodes.items() if any(entry[2] == name for entry in self.entries)
        }
        return MasterGraph(frozenset(self.entries), types, nodes, dict(self.services))

    async def parameters(self) -> dict[str, Value]:
        self._require()
        return copy.deepcopy(self.tree)

    async def ask_all(self, calls: list[MasterCall]) -> list[Value]:
        self._require()
        return [self._counted(call) for call in calls]

    def _counted(self, call: MasterCall) -> Value:
        self.calls_until_kill -= 1
        if self.calls_until_kill == 0:
            raise KilledError
        return self.carry_out(*call)

    def carry_out(self, method: str, name: str, params: tuple[Value, ...]) -> Value:
        """Change the graph as `rosmaster` does."""
        if method == "setParam":
            self.tree[str(params[0])[1:]] = params[1]
        elif method == "deleteParam":
            self.tree.pop(str(params[0])[1:], None)
        else:
            begins = "unregister" if method.startswith("unregister") else "register"
            kind = _KINDS[method.removeprefix(begins)]
            entry = kind, str(params[0]), name
            if begins == "unregister":
                self.entries.discard(entry)
                return 1
            uri = str(params[-1])
            if name in self.nodes and self.nodes[name] != uri and any(one[2] == name for one in self.entries):
                self.shutdowns.append(self.nodes[name])
            self.entries.add(entry)
            self.nodes[name] = uri
            if kind == "service":
                self.services[str(params[0])] = str(params[1])
        return 1


class RobotWorld:
    def __init__(self, parts: ControlParts) -> None:
        self.parts = parts
        self.master = ScriptedReader()
        self.robot: dict[str, RobotNode] = {}
        self.record = AdoptRecord(
            wanted=True, program="/usr/bin/rosmaster", user="robot", unit="roscore.service"
        )
        self.holder: RobotMaster | None = RobotMaster(7, "/usr/bin/rosmaster", "robot", "roscore.service")
        self.resolved: dict[str, list[str]] = {}
        self.forwarded = self.silent = False
        self.cuts: list[set[int]] = []
        self.kept: dict[str, str] = {}  # connections that the supervisor does not cut, by their ports
        self.steps: list[str] = []
        self.killed_after = ""
        self.after: dict[str, Callable[[], None]] = {}
        """The acts of the robot after a step, once."""
        self.told_while_silent: list[str] = []
        self.began: list[str] = []  # the order of registrations at RVMaster
        self.limit = self.silent_host = ""
        self.left = False
        self.remote: list[tuple[str, int]] = []
        self.connected: set[int] = set()  # the ports of nodes whose processes are connected to the master
        self.refused: set[int] = set()  # ports that were cut
        self.apart: dict[str, int] = {}  # the ports of services that have one of their own
        self.probed: set[int] = set()  # ports that were asked for a service
        self.devices: set[int] = set()  # ports of programs that say nothing to a probe
        # What control stores after each step.
        self.kept_left, self.kept_unasked = LeftThere(), set[Incarnation]()
        self.orders_until_kill = 0
        self.begin()

    def begin(self) -> None:
        """Start control: only the registry, the record and the memory of adopted nodes are as before."""
        self.silent = False
        parts = self.parts
        records: Any = parts.records
        master: Any = self.master
        world: Any = self
        self.graph = AdoptedGraph(
            parts.registry, parts.graph, parts.subscribers, records, self._order, parts.sinks.flush
        )
        self.operation = AdoptOperation(
            self._machine, lambda _facts: master, self.graph, world,
            waiting=self._waiting, silence=self._silence, speak=self._speak, call=self._call, passed=self._passed,
            probe=self._probe,
        )  # fmt: skip
        self.operation.left = copy.deepcopy(self.kept_left)
        parts.subscribers.unasked.clear()
        parts.subscribers.unasked.update(self.kept_unasked)
        parts.subscribers.remind_all()

    # --- the robot ---

    def add(self, name: str, port: int, uri: str = "", **roles: Any) -> RobotNode:
        node = self.robot[name] = RobotNode(name, uri or f"http://base:{port}/", port, **roles)
        self.resolved.setdefault("base", ["127.0.1.1"])
        self.register(node)
        if not self.forwarded:
            self.tell_as_own_master()
        return node

    def add_nodes(self) -> None:
        self.add(
            "/base", 4001, publishes=("/odom", "/rosout"), subscribes=("/cmd_vel",), services=("/reset",)
        )
        self.add("/teleop", 4002, publishes=("/cmd_vel", "/rosout"), subscribes=("/odom",))
        self.add("/rviz", 4003, publishes=("/rosout",), subscribes=("/odom",))

    def tell_as_own_master(self) -> None:
        for node in self.robot.values():
            for topic in node.subscribes:
                self.give_list(
                    node, topic, [one.uri for one in self.robot.values() if topic in one.publishes]
                )

    def register(self, node: RobotNode) -> None:
        self.master.entries |= node.entries()
        self.master.nodes[node.name] = node.uri
        self.master.services |= dict.fromkeys(node.services, f"rosrpc://base:{node.port + 1000}")

    def truth(self) -> set[Entry]:
        return {entry for node in self.robot.values() if node.alive for entry in node.entries()}

    def adopted(self) -> set[Entry]:
        return {entry for entry, _node in self.graph.all_registrations()}

    # --- what the operation uses ---

    def tree(self) -> Mapping[str, Value]:
        return self.parts.parameters.tree

    async def take(self, values: Mapping[str, Value]) -> dict[str, str]:
        parts = self.parts
        rights = ParameterRights(lambda: parts.current, parts.records)
        calls = ParameterCalls(
            parts.rosmaster, parts.parameters, parts.subscribers.parameter_set, rights, 1 << 20
        )
        left = {self.limit: "too large"} if self.limit and self.limit in values else {}
        wanted = {name: value for name, value in values.items() if name not in left}
        return left | await ParameterOrders(calls, lambda: LINK).take(wanted)

    async def _order(self, host: Address, method: str, /, *params: Value) -> list[Value]:
        self.began.append(method)
        try:
            answer: Any = await self.parts.ask(method, *params, host=str(host))
        except EncodingError as error:  # only the test's own body has a notation
            return [-1, str(error), 0]
        self.orders_until_kill -= 1
        if self.orders_until_kill == 0:
            raise KilledError
        return list(answer)

    async def _machine(self, work: str, /, **terms: Any) -> dict[str, Any]:
        match work:
            case "look":
                return dict(msgspec.to_builtins(self._facts(terms["ports"])))
            case "want":
                self.record = msgspec.structs.replace(self.record, wanted=bool(terms["wanted"]))
            case "phase":
                self.record = msgspec.structs.replace(self.record, phase=Phase(terms["phase"]))
            case "forward":
                self.forwarded = True
            case "cut":
                self.refused |= set(terms["ports"])
                self._end(lambda uri: self._port(uri) in self.refused)
                self.cuts.append(set(terms["ports"]))
                self.remote = terms["remote"]
                return {"master": 1, "nodes": len(terms["ports"]), "kept": self.kept}
            case "stand in":
                if not self.operation.forwards:
                    self.refused.clear()
                if self.holder is None:
                    self.holder = RobotMaster(8, "/usr/bin/rosmaster", "robot", "rosrv-left-master.service")
                    self.record = msgspec.structs.replace(self.record, stand_in=8)
                    self.master.entries.clear()
                    self.master.alive = True
                    return {"started": True}
            case "withdraw":
                self.record = msgspec.structs.replace(self.record, phase=Phase.GIVING)
                self.forwarded = False
                self.refused.clear()
            case "leave":
                self._end(lambda uri: not self._port(uri))
                self.left = True
            case _:
                raise AdoptError(work)
        return {}

    def _facts(self, ports: list[int]) -> MachineFacts:
        return MachineFacts(
            self.record, LINK, "10.111.0.2", own=["127.0.0.1", "192.168.50.1"], master=self.holder,
            sockets={port: [*self._process_of(port)] for port in ports if self._process_of(port)},
            reaches={port: "127.0.0.1" for port in ports if {*self._process_of(port)} & self.connected},
            resolved=self.resolved,
        )  # fmt: skip

    def _process_of(self, port: int) -> tuple[int, ...]:
        """Return the ports of the process that listens on this one: a node's API, and its topics."""
        found = (node.port for node in self.robot.values() if node.alive)
        return next(((api, api + 1000) for api in found if port in (api, api + 1000)), ())

    async def _call(self, uri: NodeUri, method: str, /, *params: Value) -> Value:
        if uri.host == self.silent_host and method == "getPid":
            await asyncio.sleep(_NODE_SECONDS)
            raise UnansweredError(f"{uri.host}:{uri.port} does not answer")
        if uri.host == self.silent_host:
            await asyncio.Event().wait()
        node = next((one for one in self.robot.values() if one.alive and one.port == uri.port), None)
        if node is None and self._process_of(uri.port):
            await asyncio.sleep(_NODE_SECONDS)
            raise UnansweredError(f"{uri.host}:{uri.port} does not answer")
        if node is None or ipaddress.ip_address(uri.host).is_loopback:
            raise CallFailedError(f"{uri.host}:{uri.port} refuses")
        if node.hangs:
            if method == "publisherUpdate":
                self.give_list(node, str(params[0]), _texts(params[1]))
            await asyncio.sleep(_NODE_SECONDS)
            raise UnansweredError(f"{uri.host}:{uri.port} does not answer")
        if method == "requestTopic":
            if node.tells == "nothing":
                raise UnansweredError(f"{uri.host}:{uri.port} does not answer")
            if node.tells == "refusal" and params[0] not in node.publishes:
                return [0, "not a publisher", 0]
            return [1, "", ["TCPROS", "base", uri.port + 1000]]
        if method == "publisherUpdate":
            node.earlier.append((str(params[0]), _texts(params[1])))
            self.give_list(node, str(params[0]), _texts(params[1]))
        if method == "getBusInfo":
            rows = [
                (topic, link) for topic, links in node.links.items() for link in links
            ]  # also those that ended
            rows += [(topic, "http://earlier:1/") for topic, looks in node.reads_on.items() if looks]
            node.reads_on = {topic: max(0, looks - 1) for topic, looks in node.reads_on.items()}
            return [1, "", [[0, one, "i", "TCPROS", topic, True] for topic, one in rows]]
        return [1, "", node.port]

    async def _probe(self, uri: NodeUri, service: str) -> bool:
        self.probed.add(uri.port)
        if uri.port in self.devices:
            raise UnansweredError(f"{service} did not answer")
        served = (one for one in self.robot.values() if one.alive and service in one.services)
        return uri.port in (self._service_port(one, service) for one in served)

    def _service_port(self, node: RobotNode, service: str) -> int:
        return self.apart.get(service, node.port + 1000)

    def give_list(self, node: RobotNode, topic: str, uris: list[str]) -> None:
        if node.hangs:
            node.held.append((topic, uris))
            return
        if node.reads_on.get(topic) and uris:
            node.heard_both.add(topic)
        node.lists[topic] = uris
        node.take_list(topic, uris)
        if not node.slow:
            node.connect(self._reaches)

    def _port(self, uri: str) -> int:
        """Return the port of topics of the robot's node with this URI; 0 if that is the appliance's."""
        return next((node.port + 1000 for node in self.robot.values() if node.uri == uri), 0)

    def _reaches(self, uri: str) -> bool:
        return self._port(uri) not in self.refused

    def connect_all(self) -> None:
        for node in self.robot.values():
            node.connect(self._reaches)

    def _end(self, ends: Callable[[str], bool]) -> None:
        """End connections to publishers; what was begun before stands first."""
        before, self.refused = self.refused, set()
        self.connect_all()
        self.refused = before
        for node in self.robot.values():
            for links in node.links.values():
                links.update(dict.fromkeys(filter(ends, links), False))
            if node.lags:
                node.reads_on = {topic: node.lags for topic, links in node.links.items() if links}

    def _waiting(self) -> int:
        self.hear()
        return 0

    async def _passed(self, step: str) -> None:
        await self.parts.settle()
        self.hear()
        self.steps.append(step)
        self.kept_left = copy.deepcopy(self.operation.left)
        self.kept_unasked = {*self.parts.subscribers.unasked}
        self.after.pop(step, lambda: None)()
        if step == self.killed_after:
            self.killed_after = ""
            raise KilledError

    def _silence(self) -> None:
        self.hear()
        self.silent = True

    def _speak(self) -> None:
        self.silent = False

    def hear(self) -> None:
        """Give the nodes the lists that control has sent; a silent control sends none."""
        for seen in self.parts.seen:
            if isinstance(seen, Told) and seen.call.method == "publisherUpdate" and not self.silent:
                node = self.robot.get(seen.node.name)
                if node is not None and node.alive and node.uri == seen.node.api_text:
                    self.give_list(node, str(seen.call.parameters[0]), _texts(seen.call.parameters[1]))
        self.parts.seen.clear()

    async def until_settled(self) -> None:
        """Do as control does at its start, and each time after it was killed."""
        settled = False
        for _ in range(4):
            try:
                facts = await self.operation.facts()
                await self.operation.settle(facts, settled=settled)
                settled = True
                if not self._is_owed():
                    return
            except KilledError:
                self.begin()
                settled = False
        raise AssertionError("it does not settle")

    async def release(self) -> None:
        self.record = msgspec.structs.replace(self.record, wanted=False)
        await self.until_settled()

    def _is_owed(self) -> bool:
        return (self.record.phase is Phase.TAKEN) != self.record.wanted


def _texts(value: Value) -> list[str]:
    assert isinstance(value, list)
    return [str(text) for text in value]
