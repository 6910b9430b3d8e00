"""Everything that a feature may use of control. The author of a feature reads this file alone.

1. `begin(core)` of each feature runs once, in the order of `features/table.py`, when control has all its parts, before
   a policy is in force and a specification is loaded. It returns the feature's `ControlPart`.
2. A feature *provides* what it has for others under a name that the core knows without the feature, such as hosts of
   the policy, a service of the appliance's own node, or the sessions of people. The core has no field for a single
   feature; without a feature that provides a service, it has an answer of its own.
3. `ControlPart.work` begins when control serves, so a policy is in force.
"""

from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import reduce

from appliance.channel import messages
from appliance.channel.answers.graph_answers import Graph, Topic
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.answers.status import ProcessInfo, Status
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.link import Link
from appliance.channel.messages.api import TokenKept
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.hosts import SiteHosts
from appliance.control.assembly.policies import Policies
from appliance.control.assembly.services import CallHolder, HeldCalls, Provided
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.node_connections import NodeConnections
from appliance.control.operators.request_method import RequestMethod
from appliance.control.operators.token_orders import Sessions
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.endpoints.host_signs import HostSigns
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Address, CallHold, Request
from appliance.policy.policy import Policy
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import Value

LONGEST = 64 << 20
"""The largest message of a process in bytes, unless its link has a smaller limit."""


@dataclass(frozen=True)
class ControlPart:
    """A feature's part of control.

    `methods` answer requests. `work` runs while control serves; its keys go into error messages. `status` returns the
    feature's fields in `rosrv status --json`; a field without a state is null there.
    """

    methods: tuple[RequestMethod[object], ...] = ()
    work: Mapping[str, Callable[[], Awaitable[None]]] = field(default_factory=dict)
    status: Callable[[], Mapping[str, object]] = dict


class Links:
    """The processes of features, and requests to the supervisor."""

    def __init__(self, lifeline: ControlLifeline, received: Callable[[int], None]) -> None:
        self._lifeline = lifeline
        self._links: dict[tuple[str, int], tuple[Link, object, int]] = {}
        self.received = received
        """Notes that another machine has all audit records up to a sequence."""

    def attach(
        self, role: str, link: Link, accepted: object, *, index: int = 0, longest: int = LONGEST
    ) -> None:
        """Attach control's end of the link to a process; `accepted` is the union of the messages it may send."""
        self._links[role, index] = link, accepted, longest

    def of(self, role: str, index: int) -> tuple[Link, object, int] | None:
        """Return what a feature attached, or None."""
        return self._links.get((role, index))

    def start(self, role: str, index: int = 0) -> None:
        self._lifeline.say(messages.ProcessWanted(role, index))

    def kill(self, role: str, index: int = 0) -> None:
        """Kill a process that should have ended, or that lost its link."""
        self._lifeline.say(messages.ProcessOverdue(role, index))

    def before_end(self, work: Callable[[], Awaitable[None]]) -> None:
        """Finish work before an ordered end of the appliance."""
        self._lifeline.before_end(work)

    def after_removal(self, work: Callable[[], None]) -> None:
        """Call `work` when rules of the firewall are in force again that another program had removed."""
        self._lifeline.after_removal(work)

    def processes(self) -> list[ProcessInfo]:
        return self._lifeline.surroundings.processes

    async def machine_work(self, feature: str, work: str, **terms: object) -> dict[str, object]:
        """Let the supervisor do work of a feature (`machine_side.py`). Raises `MachineWorkFailedError`."""
        return await self._lifeline.questions.machine_work(feature, work, **terms)

    async def open_own_network(self, network: str, ports: list[int]) -> str:
        """Let the firewall reserve a network for control's own addresses; return the problem, or an empty string."""
        return await self._lifeline.questions.open_own_network(network, ports)

    async def endpoint(self) -> messages.EndpointFound:
        """Find the address at which hosts reach the appliance."""
        return await self._lifeline.questions.endpoint()


class PolicyFacts:
    """The policy in force. `charged_to(host)` returns the name that is charged for a host's acts."""

    def __init__(self, revisions: Policies, charged_to: Callable[[str], str]) -> None:
        self.revisions = revisions
        """Loads policies, and rolls back."""
        self._provided: list[Callable[[PolicyContext], PolicyContext]] = []
        self.listeners: list[Callable[[], None]] = []
        self.first: list[Callable[[], None]] = []
        self.charged_to = charged_to
        self.in_words = revisions.in_words

    def current(self) -> Policy:
        return self.revisions.current

    @property
    def revision(self) -> int:
        return self.revisions.revision

    def provide(self, facts: Callable[[PolicyContext], PolicyContext]) -> None:
        """Add facts to those that policies decide with, such as `known.with_hosts(…)`.

        After a change of hosts, call `hosts_changed`, and `decide_again` after others.
        """
        self._provided.append(facts)

    def hosts(self) -> Mapping[str, Address]:
        """Return the hosts that features provide."""
        return self.added_to(PolicyContext()).hosts

    def added_to(self, known: PolicyContext) -> PolicyContext:
        return reduce(lambda known, facts: facts(known), self._provided, known)

    def on_change(self, listener: Callable[[], None]) -> None:
        """End everything that the new policy does not allow, even if the next policy allows it again.

        A policy also changes with its hosts: a door that is removed and added again has the same name and address.
        """
        self.listeners.append(listener)

    def on_first(self, begun: Callable[[], None]) -> None:
        """Call `begun` when this process has its first policy, before stored registrations are restored."""
        self.first.append(begun)

    def hosts_changed(self) -> int:
        return self.revisions.hosts_changed()

    def decide_again(self) -> int:
        return self.revisions.decide_again()


@dataclass(frozen=True, slots=True)
class Registrar:
    """Registers nodes at RVMaster as if they had registered themselves.

    `call(host, local, method, parameters)` makes a call of the Master API as if a node of this host had made it at
    the appliance's address `local`. It is decided, charged and recorded in the same way.
    """

    registry: Registry
    graph: RosGraph
    subscribers: Subscribers
    parameters: ParameterCalls
    flush: Callable[[], None]
    call: Callable[[Address, str, str, tuple[Value, ...]], Awaitable[Value]]
    ready: Callable[[], Awaitable[object]]
    """Waits until the ROS master has all registrations."""
    silence: Callable[[], None]
    """Sends nothing more to nodes, until `speak`."""
    speak: Callable[[], None]


@dataclass(frozen=True)
class GraphFacts:
    """The nodes of the robot, with their topics, services and connections."""

    present: Callable[[], Graph]
    topic: Callable[[str], Topic]
    """Returns a topic by its name, or raises `UnknownThingError`; cheap, however many topics there are."""
    host_of: Callable[[str], Address | None]
    """Returns the host of the node with a name."""
    name_of: Callable[[str], str]
    """Returns the name of a node by its key; empty if it has ended."""
    machines: Callable[[], dict[str, int]]
    """Returns the number of live nodes by address."""
    connected: Callable[[], Iterable[set[str]]]
    """Returns the two hosts of each connection."""
    live_rights: Callable[[], list[LiveRight]]
    """Returns the rights that a change of the policy may end."""
    expel: Callable[[Address, str], int]
    """Ends everything of a host; returns the number of revocations."""
    signs: HostSigns
    master_port: int
    connections: NodeConnections
    registrar: Registrar


class RelayOrders:
    """Orders to the relays, which carry the messages. `changed` registers what the own node publishes."""

    def __init__(self, relay: RelayControl, holder: CallHolder, changed: Callable[[], None]) -> None:
        self._relay = relay
        self._holder = holder
        self._changed = changed
        self._published: dict[str, set[str]] = {}  # by owner
        self.ranks = relay.ranks
        """The drivers of topics with a rank."""
        self.publish = relay.publish
        """Publishes a message on a topic of `publish_only`."""
        self.look = relay.taps.look
        self.stop = relay.taps.stop
        """Lets the monitors of a topic send their safe messages, and returns their names; None: no relay answers."""
        self.stoppers = relay.taps.stoppers
        """Returns the monitors that have a safe message for a topic; None: its relay does not answer."""
        self.test = relay.taps.test
        """Lets a relay test a copy of a guard."""
        self.carried_out = relay.carried_out

    def hold(
        self,
        call: Callable[[Request], CallHold],
        request: Callable[[messages.RequestHeld], Awaitable[messages.HeldRequestDecided]],
    ) -> None:
        """Take all calls that need an approval.

        `call` holds a call of the Master API, and returns the text for the caller. `request` decides about one
        request to a service.
        """
        self._holder.held.provide(HeldCalls(call, request))

    def publish_only(self, owner: str, headers: Iterable[messages.OwnHeaderStated]) -> None:
        """Let the appliance's own node publish these topics, and no others of the owner's earlier calls."""
        before, now = self._published.get(owner, set()), set[str]()
        for header in headers:
            self._relay.begin_own_topic(header)
            now.add(header.topic)
        self._published[owner] = now
        for topic in before - now:
            self._relay.end_own_topic(topic)
        if before != now:
            self._changed()

    def ready(self) -> bool:
        return self._relay.presence == "connected"


OwnServiceAnswer = Callable[[messages.OwnServiceCalled], Awaitable[messages.OwnServiceAnswered]]


class OwnServices:
    """The services on the appliance's own node."""

    def __init__(self) -> None:
        self._answers: dict[str, OwnServiceAnswer] = {}

    def provide(self, name: str, answer: OwnServiceAnswer) -> None:
        """Answer the calls of the services whose names end with `/` and this name."""
        self._answers[name] = answer

    async def called(self, call: messages.OwnServiceCalled) -> messages.OwnServiceAnswered:
        (answer,) = (answer for name, answer in self._answers.items() if call.service.endswith(f"/{name}"))
        return await answer(call)


WebSocketHandler = Callable[[str, str, str, int], tuple[int, str]]
"""`handler(name, ticket, peer, descriptor)` takes a WebSocket of the api, and returns an HTTP status and the reason of
a refusal.
"""
_NO_WEBSOCKETS = (404, "there are no doors")


class RestServices:
    """The WebSockets of REST, which a feature may take."""

    def __init__(self) -> None:
        self._websocket: Provided[WebSocketHandler] = Provided()

    def websocket(self, handler: WebSocketHandler) -> None:
        """Take the WebSockets whose paths begin with `/door/`."""
        self._websocket.provide(handler)

    def accept_websocket(self, name: str, ticket: str, peer: str, descriptor: int) -> tuple[int, str]:
        handler = self._websocket()
        return _NO_WEBSOCKETS if handler is None else handler(name, ticket, peer, descriptor)


@dataclass(frozen=True)
class Bearers:
    """The usable tokens, and the sessions of people who signed in. Call `changed` when sessions begin or end."""

    usable: Callable[[], list[TokenKept]]
    changed: Callable[[], None]
    sessions: Provided[Sessions]

    def people(self) -> list[SignedOn]:
        """Return the sessions of people."""
        sessions = self.sessions()
        found = [] if sessions is None else [sessions.of(row.id) for row in sessions.rows()]
        return [session for session in found if session is not None]

    def provide(self, sessions: Sessions) -> None:
        self.sessions.provide(sessions)


class ResourceUses:
    """The use of finite resources."""

    def __init__(self, own: Callable[[], Iterable[LimitUse]]) -> None:
        self._uses = [own]

    def provide(self, uses: Callable[[], Iterable[LimitUse]]) -> None:
        self._uses.append(uses)

    def uses(self) -> list[LimitUse]:
        return [use for uses in self._uses for use in uses()]


@dataclass(frozen=True)
class Alarms:
    """The present alarms, in the status, and those that operators handled."""

    status: Callable[[], Status]
    handled: HandledAlarms


@dataclass(frozen=True)
class Core:
    """All of control that features use."""

    settings: Settings
    role: ActiveRole
    trail: AuditTrail
    store: StateStore
    ends: EndTable
    links: Links
    policy: PolicyFacts
    specifications: SpecificationManager
    hosts: SiteHosts
    graph: GraphFacts
    relay: RelayOrders
    rest: RestServices
    own_services: OwnServices
    bearers: Bearers
    limits: ResourceUses
    alarms: Alarms
