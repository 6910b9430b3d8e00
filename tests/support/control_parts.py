"""The parts of RVMaster, which control itself connects.

Models of everything else record their calls, and give the answers that a test sets.
"""

import asyncio
import ipaddress
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Self, cast
from unittest.mock import patch

from appliance.audit.log.record import AuditRecord
from appliance.channel import messages
from appliance.configuration.settings import LivenessSection, Settings
from appliance.control import control
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.listener_limits import ListenerLimits
from appliance.control.assembly.services import HeldCalls
from appliance.control.control import INNER, RVMASTER, Control
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.master.endpoints.delivery import Delivery, NodeCall
from appliance.master.endpoints.relay_control import OwnCall
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry, new_key
from appliance.master.reconcile.sinks import StoredGraph
from appliance.master.rosmaster import Answer, RosMaster, Wanted
from appliance.policy.model import Address, CallHold, Decision, Request
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler, HttpRequest, Peer
from appliance.rpc.xmlrpc_client import XmlRpcClient
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import Database
from roswire.parameter_tree import standing_at
from roswire.uris import NodeUri, parse_node_uri
from roswire.xmlrpc import Value, build_call, parse_response
from tests.support.autojump import own_tasks
from tests.support.core import FakeTrail
from tests.support.idle import idle
from tests.support.memory_channel import HeldChannel
from tests.support.memory_ports import face, listening, memory_ports
from tests.support.parameters import mirror, put, registered
from tests.support.scripted_nodes import ScriptedNodes

HOST = ipaddress.ip_address("10.0.0.5")
POLICY = "[Nodes]\ndefault=*\n[Publishers]\n{}default=*\n[Subscribers]\n{}default=*\n[Commands]\ndefault=*\n"
OPEN = POLICY.format("", "")
_INNER_PORT = 9
_TABLES = {"Publisher": Kind.PUBLICATION, "Subscriber": Kind.SUBSCRIPTION, "Service": Kind.SERVICE}


class Denied(NamedTuple):
    category: str
    resource: str
    decision: Decision
    about: dict[str, str]
    record: str
    """The id of the record."""


class Told(NamedTuple):
    node: Incarnation
    call: NodeCall


class Ended(NamedTuple):
    what: str
    node: Incarnation


class Record(NamedTuple):
    event: str
    caller_id: str
    category: str
    resource: str


Seen = Told | Ended | Record | messages.Message | Wanted
"""An action of control: for a node, in the audit log, at the relay, or at the ROS master."""

_OF_GRAPH = {"registered", "unregistered", "revoked", "replaced", "takeover", "node lost", "node returned"}


class Records(FakeTrail):
    """The trail of these parts. Records about the graph are noted in the order of all that is seen."""

    def __init__(self, note: Callable[[Seen], None] = lambda _seen: None) -> None:
        super().__init__(self._recorded)
        self._see = note
        self.denied: list[Denied] = []
        self.refused: list[str] = []

    def clear(self) -> None:
        self.records.clear()
        self.denied.clear()
        self.refused.clear()

    @property
    def pairs(self) -> list[tuple[str, str | None]]:
        """Return the event of each record, or its decision, with the resource."""
        return [
            (str(record.decision) if record.event == "decision" else record.event, record.resource)
            for record in self.records
        ]

    def decided(
        self, asker: Any, method: str, category: str, resource: str, decision: Decision, **more: Any
    ) -> str:
        record = super().decided(asker, method, category, resource, decision, **more)
        if decision.would_deny:
            self.refused.append(f"would deny: {category} {resource}")
        if not decision.allowed:
            about = {name: value for name, value in more.items() if name != "reads"}
            self.denied.append(Denied(category, resource, decision, about, record))
        return record

    def _recorded(self, record: AuditRecord) -> None:
        caller_id, category, resource = record.caller_id or "", str(record.category), str(record.resource)
        if record.event in _OF_GRAPH:
            self._see(Record(record.event, caller_id, category, resource))
        if record.event in {"malformed", "limit exceeded"}:
            self.refused.append(f"{record.event}: {caller_id} {category} {resource}")


class Deliveries(Delivery):
    """Notes each call, and makes none. `told` has the calls with the names of their nodes."""

    def __init__(self, note: Callable[[Seen], None]) -> None:
        self.told: list[tuple[str, str, tuple[Value, ...]]] = []
        self._note = note
        self._removed: dict[tuple[str, str], frozenset[str]] = {}
        self._published: dict[tuple[str, str], tuple[str, ...]] = {}

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        self.told.append((incarnation.name, call.method, call.parameters))
        self._note(Told(incarnation, call))

    def push_unasked(self, incarnation: Incarnation, _key: str, call: NodeCall) -> None:
        self.push(incarnation, call)

    def list_of(self, incarnation: Incarnation, topic: str) -> tuple[str, ...] | None:
        return self._published.get((incarnation.key, topic))

    def push_list(self, incarnation: Incarnation, topic: str, publishers: tuple[str, ...]) -> None:
        self._published[incarnation.key, topic] = publishers
        if removed := self._removed.pop((incarnation.key, topic), None):
            without: list[Value] = [publisher for publisher in publishers if publisher not in removed]
            self.push(incarnation, NodeCall("publisherUpdate", (topic, without)))
        self.push(incarnation, NodeCall("publisherUpdate", (topic, list(publishers))))

    def remove_first(self, incarnation: Incarnation, topic: str, publishers: frozenset[str]) -> None:
        self._removed[incarnation.key, topic] = publishers

    def answered(self, incarnation: Incarnation, topic: str, publishers: tuple[str, ...]) -> None:
        self._published[incarnation.key, topic] = publishers

    def drop_list(self, incarnation: Incarnation, topic: str) -> None:
        self._published.pop((incarnation.key, topic), None)

    def forget_lists(self, incarnation: Incarnation) -> None:
        self._published = {key: one for key, one in self._published.items() if key[0] != incarnation.key}

    def drop(self, incarnation: Incarnation) -> None:
        self.forget_lists(incarnation)
        self._note(Ended("drop what waits for", incarnation))


class NoSpecifications:
    """Specifications without a monitor. `lost` has the relays that ended."""

    def __init__(self) -> None:
        self.checked = CheckedSpecifications()
        self.lost: list[int] = []

    def statement(self, _relay: int) -> messages.SpecificationsStated:
        return messages.SpecificationsStated(0, b"", {}, restarted=False)

    def received(self, message: messages.Message, relay: int) -> None:
        raise AssertionError(f"relay {relay} reports of no monitor: {message}")

    def relay_lost(self, relay: int) -> None:
        self.lost.append(relay)


class HiddenMaster(XmlRpcClient):
    """The connections to a ROS master that carries out each call in this process.

    `requests` has the method of each request, and `calls` all calls. Requests wait for `go`; then they get `failure`
    or `answer`, if these are set.
    """

    def __init__(self, note: Callable[[Seen], None]) -> None:
        super().__init__(NodeUri("http", "127.0.0.1", 1, "/"), timeout=1.0)
        self._note = note
        self.calls: list[tuple[Value, ...]] = []
        self.requests: list[str] = []
        self.under_way = self.most_under_way = 0
        self.failure: Exception | None = None
        self.answer: Value = None
        self.tables: dict[Kind, dict[str, dict[str, str]]] = {kind: {} for kind in _TABLES.values()}
        self.nodes: dict[str, str] = {}
        self.parameters: dict[str, Value] = {"run_id": "1"}
        self.pid = 4711
        self.go = asyncio.Event()
        self.go.set()

    async def call(self, method: str, *params: Value) -> Value:
        self.requests.append(method)
        self.under_way += 1
        self.most_under_way = max(self.most_under_way, self.under_way)
        try:
            await asyncio.sleep(0)
            await self.go.wait()
            answer = self._carry_out_all(method, params)
        finally:
            self.under_way -= 1
        if self.failure is not None:
            raise self.failure
        return answer if self.answer is None else self.answer

    def _carry_out_all(self, method: str, params: tuple[Any, ...]) -> Value:
        if method == "system.multicall":
            return [[self.carry_out(part["methodName"], *part["params"])] for part in params[0]]
        return self.carry_out(method, *params)

    def carry_out(self, method: str, *params: Value) -> Answer:
        self.calls.append((method, *params))
        for beginning in ("register", "unregister"):
            kind = _TABLES.get(method.removeprefix(beginning))
            if kind is not None and method.startswith(beginning):
                self._note((method, params))
                return self._change(beginning, kind, *(str(param) for param in params))
        return self._answer(method, params)

    def _answer(self, method: str, params: tuple[Value, ...]) -> Answer:
        if method == "lookupNode" and params[1] not in self.nodes:
            return [-1, "unknown", ""]
        if method in {"setParam", "deleteParam"}:
            return self._write(method, str(params[1]), *params[2:])
        asked = str(params[-1])
        values: dict[str, Value] = {
            "getPid": self.pid,
            "getSystemState": [
                [[resource, list(nodes)] for resource, nodes in table.items() if nodes]
                for table in self.tables.values()
            ],
            "lookupNode": self.nodes.get(asked),
            "getTopicTypes": [],
            "lookupService": next(iter(self.tables[Kind.SERVICE].get(asked, {}).values()), ""),
            "hasParam": asked[1:] in self.parameters,
            "getParam": dict(self.parameters),
            "subscribeParam": self.parameters.get(asked[1:], {}) if asked != "/" else dict(self.parameters),
            "unsubscribeParam": 1,
        }
        if method == "searchParam":
            return self._search(str(params[0]), asked)
        return [1, "", values[method]]

    def _write(self, method: str, key: str, *value: Value) -> Answer:
        there = mirror(self.parameters)
        was = standing_at(there.tree, key)[0] if key != "/" else None  # the root cannot be deleted
        if value:
            put(there, key, value[0], HOST)
            self.parameters = there.tree
            return [1, f"parameter {key} set", 0]
        there.delete(key)
        return [-1, f"parameter [{key}] is not set", 0] if was is None else [1, f"parameter {key} deleted", 0]

    def _search(self, caller_id: str, key: str) -> Answer:
        if not caller_id:
            return [0, "Internal failure: namespace must be global", 0]
        first = key.strip("/").split("/")[0]
        above = [] if key.startswith("/") else caller_id.strip("/").split("/")
        for depth in range(len(above), -1, -1):
            base = "".join(f"/{part}" for part in above[:depth])
            if standing_at(self.parameters, f"{base}/{first}")[0] is not None:
                name = f"{base}/{key.strip('/')}"
                return [1, f"Found [{name}]", name]
        return [-1, f"Cannot find parameter [{key}] in an upwards search", ""]

    def _change(self, how: str, kind: Kind, name: str, resource: str, *rest: str) -> Answer:
        table = self.tables[kind].setdefault(resource, {})
        if how == "register":
            if kind is Kind.SERVICE:
                table.clear()  # it keeps the last provider
            table[name] = rest[0] if kind is Kind.SERVICE else rest[-1]
            self.nodes[name] = rest[-1]
            return [1, "", []]
        return [1, "", int(table.pop(name, None) is not None)]

    def restart(self) -> None:
        self.pid += 1
        self.tables = {kind: {} for kind in _TABLES.values()}
        self.nodes, self.parameters = {}, {}

    def has(self, kind: Kind, resource: str) -> list[str]:
        return list(self.tables[kind].get(resource, {}))


def _held(request: Request) -> CallHold:
    return CallHold(f"held: {request.resource}", waits=True)


async def no_own_call(asked: OwnCall) -> Any:
    raise AssertionError(f"a relay asks {asked}")


class ControlParts(Control):
    """The connected parts. `reload(text)` puts another policy in force, and `settle()` waits for its consequences."""

    def __init__(self, *, silent: float = 0.0, store: StateStore | None = None) -> None:
        self._not_ours = own_tasks()  # the test's own
        self.seen: list[Seen] = []
        self.full = False  # whether the relay reads nothing
        self.shut_out = False  # whether the robot's firewalls may refuse connections
        note = self.seen.append
        self.settings = Settings(isolation="none", liveness=LivenessSection(silent=silent), relays=1)
        self.lifeline = idle(ControlLifeline)
        self.role = idle(ActiveRole, in_doubt=lambda: self.shut_out)
        self.policy, self.registry, self.quota_class = CurrentPolicy(), Registry(), cast(Any, registered)
        self.current = compile_policy(OPEN, file="policy")
        self.trail = self.records = Records(note)
        self.listener_limits = idle(ListenerLimits, server=self._face, time=ProcessorTime(lambda host: host))
        self.sockets = {RVMASTER: listening("10.0.0.1", 11311), INNER: listening("127.0.0.1", _INNER_PORT)}
        self.hidden, self.nodes = HiddenMaster(note), ScriptedNodes(self.registry)
        self.deliveries = Deliveries(note)
        self.delivery: Delivery = self.deliveries
        self.specifications = NoSpecifications()
        self.go = asyncio.Event()  # arriving nodes wait for it
        self.go.set()
        self.store = store or idle(StateStore, database=idle(Database))
        doubles: dict[str, Any] = {
            "Delivery": lambda *_, **__: self.delivery,
            "NodeApiClient": lambda *_, **__: self.nodes,
            "NodePorts": lambda *_, **__: memory_ports(self.policy),
            "ParameterCharges": lambda *_: None,
            "ParameterMirror": lambda *_, **__: mirror(),
            "RosMaster": partial(RosMaster, hold=1.0),
            **({"StoredGraph": lambda *_: idle(StoredGraph)} if store is None else {}),
        }
        with patch.multiple(control, **doubles):
            self._make_graph()
            self.surround()
            self._make_endpoints()
        self.rosmaster.calls = self.hidden
        self.relay.descriptor = lambda port: port  # those of `node` have no socket
        self.calls.held.provide(HeldCalls(_held, no_own_call))
        self._make_calls()
        self.start_relay()
        self.serve = self.pipeline.handler(self.table)

    def _make_monitors(self) -> Any:
        return self.specifications

    @property
    def current(self) -> Policy:
        return self.policy()

    @current.setter
    def current(self, policy: Policy) -> None:
        self.policy.set(policy)

    def surround(self) -> None: ...

    def _face(self, sock: Any, _handler: Handler) -> Any:
        port = sock.getsockname()[1]
        return self._face_of(next(node for node in self.registry.all() if node.outer_port == port))

    def _face_of(self, node: Incarnation) -> Any:
        return face(lambda: self.seen.append(Ended("close", node)), self.go)

    @classmethod
    async def begun(cls) -> Self:
        world = cls()
        await world.round()
        return world

    @property
    def lives(self) -> list[Life]:
        return [one.life for one in self.registry.all()]

    def node(self, name: str, number: int = 1, host: Address = HOST) -> Incarnation:
        uri = f"http://{host}:{4000 + number}/"
        node = Incarnation(new_key(), name, host, parse_node_uri(uri), uri, "10.0.0.1", 1, 2)
        self.registry.add(node)
        self.faces.servers[node.key] = self._face_of(node)
        return node

    async def ask(
        self,
        method: str,
        *params: Value,
        host: str = str(HOST),
        target: Incarnation | None = None,
        own: bool = False,
    ) -> Value:
        """Make a call: of RVMaster, of the node `target`, or by the appliance's own node (`own`)."""
        peer = Peer(ipaddress.ip_address(host), host, "10.0.0.1")
        serve = self.serve if target is None else self.serve_node(target)
        if own:
            serve = self.pipeline.handler(self.table, own=True)
        return parse_response(await serve(HttpRequest(peer, "/", build_call(method, params), 0)))

    async def register(self, node: Incarnation, kind: Kind, resource: str, detail: str = "4001") -> None:
        self.graph.registered(node, kind, resource, detail)
        if kind is Kind.SUBSCRIPTION:
            self.subscribers.list_for(node, resource)
        elif kind is Kind.PARAMETER:
            self.subscribers.value_given(node, resource)
        await self.settle()

    def reload(self, text: str) -> int:
        self.current = compile_policy(text, file="policy")
        return self.enforcement.policy_changed(self.current)

    def start_relay(self) -> None:
        self.relay.attach(0, HeldChannel(self.seen.append, full=lambda: self.full))

    async def round(self) -> None:
        await self.reconciler.round()

    async def look(self, node: Incarnation) -> None:
        await self.liveness.look(node)
        await self.settle()

    async def settle(self) -> None:
        self.sinks.flush()
        self.liveness.look_at_watched()
        while others := own_tasks() - self._not_ours:
            await asyncio.wait(others, timeout=5.0)
            assert all(task.done() for task in others), "tasks are still running"
            self.sinks.flush()
            self.liveness.look_at_watched()
