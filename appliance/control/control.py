"""Make the parts of control: state, log, listeners, graph, endpoints, policy, specifications, calls, features, orders.

A part is an attribute, and gets what it needs in its constructor. A function that needs a later part reads the
attribute when it is called.
"""

import asyncio
from collections.abc import Awaitable
from dataclasses import replace
from functools import partial
from ipaddress import ip_address, ip_network
from typing import Any

import structlog

from appliance.audit.log.budget import Budget, DiskParts
from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.channel import messages
from appliance.channel.answers.status import AuditState
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.assembly.hosts import SiteHosts, make_host_table
from appliance.control.assembly.listener_limits import (
    HostQuotaClass,
    ListenerLimits,
    open_listener,
    value_limits,
)
from appliance.control.assembly.monitor_states import published_now
from appliance.control.assembly.policies import Policies, passed_changes
from appliance.control.assembly.robot import charged_to, robot_addresses
from appliance.control.assembly.services import CallHolder, Provided
from appliance.control.core import (
    Alarms,
    Bearers,
    Core,
    GraphFacts,
    Links,
    OwnServices,
    PolicyFacts,
    Registrar,
    RelayOrders,
    ResourceUses,
    RestServices,
)
from appliance.control.feature_parts import FeatureParts
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.monitor_call_gate import MonitorCallGate, own_host
from appliance.control.operators.administration import Administration
from appliance.control.operators.clock_check import ClockCheck
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.limit_use import OwnUses
from appliance.control.operators.new_state import StateAge
from appliance.control.operators.node_connections import NodeConnections
from appliance.control.operators.queries import Queries, graph_of, hosts_connected, topic_of
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.switched_off import SwitchedOffWatch
from appliance.control.operators.token_orders import Sessions, TokenOrders
from appliance.control.rest.rest import RestLink, RestUses
from appliance.control.rest.rest_certificate import RestCertificate
from appliance.hosts.tunnel_state import Tunnels
from appliance.master import rosout
from appliance.master.calls.call import served_calls
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.call_table import master_table
from appliance.master.calls.gate import CallGate, HostLimits
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NODE_CALLS, NodeCalls
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterRights
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.publisher import OwnPublisher
from appliance.master.calls.registration import Arrivals, RegistrationCalls
from appliance.master.endpoints.delivery import Delivery, NodeApiClient
from appliance.master.endpoints.host_signs import host_signs
from appliance.master.endpoints.node_ports import AdvertisedAddresses, NodePorts
from appliance.master.endpoints.relay_control import OwnAnswer, OwnCall, RelayControl
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.graph.revocation import Revocation
from appliance.master.parameter_charges import ParameterCharges
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.reconcile.liveness import Liveness, Watchlist
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.reminders import RelayMoves, Reminders
from appliance.master.reconcile.sinks import Enforcement, MasterSideApi, ProxyEndpoints, Sinks, StoredGraph
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import MasterRegistrations, RosMaster, limits_of_answers, own_parameters
from appliance.policy.judgement import IN_CONTROL, PolicyContext
from appliance.policy.model import Address
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.quotas.pool import Pool
from appliance.quotas.table import AUDIT_RESERVE, PARAMETER_BYTES
from appliance.rpc.fair_queue import LargeWrites, bulk_turns
from appliance.rpc.server import Peer, listen
from appliance.specifications.allocation import Allocation
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_manager import ALLOCATION, SpecificationManager
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from roswire.parameter_tree import Tree
from roswire.standard import standard_definitions
from roswire.xmlrpc import MethodCall, Value

RVMASTER, INNER, OWN = "rvmaster", "inner", "own"
"""The names of the listeners for nodes, for the ROS master, and for the appliance's own nodes."""

_HOSTS_IN_RESERVE = AUDIT_RESERVE.bounds.whole // AUDIT_RESERVE.bounds.host
_REFUSALS = 2
_REFUSALS_OF_A_ROBOT = (
    4  # a further computer whose cable was unplugged refuses until it admits this appliance again
)
_log = structlog.get_logger()


class Control:
    """All parts of control. Call `begin`, bring a policy and specifications into force, and then call `take_orders`."""

    def __init__(
        self, settings: Settings, lifeline: ControlLifeline, compiler: SpecificationCompiler, role: ActiveRole
    ) -> None:
        """Open the log and the state. Raises `StoreError`."""
        self.settings, self.lifeline, self.compiler, self.role = settings, lifeline, compiler, role
        self.policy, self.registry = CurrentPolicy(), Registry(settings.limits.nodes_per_host)
        self.quota_class = HostQuotaClass(self.policy, self.registry.registrations_of)
        self._open_log()
        folder = settings.state / "control"
        self.store = StateStore(
            folder, failed=lambda reason: _log.error("state is not written", reason=reason)
        )
        role.inherit(self.store)
        self.ends = role.ends(self.store, folder / "age")
        self._make_hosts()

    async def begin(self) -> None:
        """Make the other parts, and let features begin. Raises `OSError` if an address is in use."""
        # The policy names hosts by address. These addresses are reliable only once clear text from them is blocked, so
        # start the tunnels before the policy.
        self.lifeline.hear_tunnels(self.hosts.tunnels.answered)
        self.role.hand_tunnels_to(self.hosts.tunnels)
        await self.hosts.tunnels.start()
        self._listen()
        self._make_graph()
        self._make_endpoints()
        self._make_policies()
        self._make_calls()
        self._make_queries()
        self._make_core()
        await self.features.begin(self.core)

    def port(self, name: str) -> int:
        return int(self.sockets[name].getsockname()[1])

    # --- state, hosts and listeners ---

    def _open_log(self) -> None:
        """Open the audit log. Hosts of a `disk_group` share a part of the free disk space."""
        settings, given = self.settings, self.settings.audit
        self.signing = SignerRequests(lambda: self.audit)
        self.receipts = ReceiptFloor(
            settings.state,
            int(given.reserve_bytes),
            holding=any(section.holds_records for section in settings.sections.values.values()),
        )
        reserve = AUDIT_RESERVE.bounds.resize(
            int(given.reserve_bytes), int(given.reserve_bytes) // _HOSTS_IN_RESERVE
        )
        size = None if given.retention_bytes is None else int(given.retention_bytes)
        self.audit = AuditLog(
            settings.state / "control" / "audit.db",
            durability=given.durability,
            checkpoint_every=given.checkpoint_records,
            checkpoint_seconds=given.checkpoint_seconds,
            signer=self.signing.want,
            removals=self.signing.want_removal,
            held_by=self.lifeline.log_held(),
            budget=Budget(
                self.quota_class.of_text,
                reserve=reserve,
                parts=DiskParts(self.quota_class.disk_group, size),
            ),
            reserve=reserve.whole,
            retention=Retention(
                days=given.retention_days,
                size=size,
                collected=self.receipts.through,
            ),
        )
        strict, deny = given.durability == "strict", given.on_audit_failure == "deny"
        self.trail = AuditTrail(self.audit, strict=strict, deny_when_failed=deny)

    def _make_hosts(self) -> None:
        blocks, table = BlockTable(self.store, self.ends), make_host_table(self.settings, self.store)
        authority = self.role.host_authority(self.signing.link, self.store, self.trail, table)
        tunnels = Tunnels(
            table,
            self.trail,
            *authority,
            listen=self.settings.listen_address,
            say=self.lifeline.say,
            blocked=lambda: blocks.reasons,
        )
        blocks.on_change(tunnels.state_anew)
        self.hosts = SiteHosts(blocks, table, tunnels, authority)

    def _listen(self) -> None:
        self.listener_limits = ListenerLimits(self.settings, self.trail, self.policy, self.quota_class)
        self.sockets = self.lifeline.sockets
        host, port = self.settings.listen_address
        for name, address in ((RVMASTER, (host, port)), (INNER, ("127.0.0.1", 0)), (OWN, ("127.0.0.1", 0))):
            if name not in self.sockets:
                self.sockets[name] = open_listener(*address)
                self.lifeline.keep(name, self.sockets[name])

    # --- RVMaster ---

    def _make_graph(self) -> None:
        """Make the parts that decide calls and change the graph, but send no messages."""
        settings, store = self.settings, self.store
        self.watchlist = Watchlist()
        self.carried = RelayTraffic(self.trail, self.registry, settings.relays, self.watchlist.cut_off)
        self.grants = Grants(self.registry.mark, self.carried.used_permissions)
        self.rights = ParameterRights(self.policy, self.trail)
        whole = int(settings.limits.parameter_bytes)
        pool = Pool("bytes of parameters", PARAMETER_BYTES.bounds.resize(whole, whole // 2), self.quota_class)
        self.parameters_dirty = asyncio.Event()
        self.parameters = ParameterMirror(
            store.load_parameters(),
            self.parameters_dirty.set,
            ParameterCharges(pool, store, store.parameter_owners()),
            depth_limit=settings.limits.nesting,
            note=store.note_parameter,
            together=store.database.together,
            since=store.parameter_changes(),
        )
        self.graph = RosGraph(self.registry, self.grants, self.trail)
        self.call_gate = CallGate(self.policy, self.registry, HostLimits(settings.limits.topics_per_host))
        self.revocation = Revocation(self.registry, self.grants, self.graph, self.policy, self._tree)

    def _tree(self) -> Tree:
        return self.parameters.tree

    def _make_endpoints(self) -> None:
        """Make the parts that carry changes of the graph to nodes, relays and the ROS master."""
        settings, registry, address = self.settings, self.registry, self.sockets[RVMASTER].getsockname()[0]
        self.calls, self.own_services = CallHolder(), OwnServices()
        self.places = NodePorts(
            settings.listen_address[0],
            range(0),  # those of the policy, once it is in force
            keep=self.lifeline.keep,
            drop=self.lifeline.drop,
            policy=self.policy,
            relays=settings.relays,
            listen=listen,
        )
        self.addresses = AdvertisedAddresses(
            [(ip_network(each.network), ip_address(each.address)) for each in settings.advertise],
            self.lifeline.questions.route_to if settings.isolation == "netns" else None,
            address,
            fixed=self.role.address,
            tunnels=settings.ipsec.pool,
        )
        nodes = NodeApiClient(registry, timeout=settings.limits.node_call_seconds)
        self.relay = RelayControl(
            registry,
            self.grants,
            self.places.descriptor,
            nodes,
            self.carried,
            allocation=Allocation(settings.relays, partial(self.store.save_setting, ALLOCATION)),
            policy=self.policy,
            monitors=lambda: self.monitors,
            broken=self.watchlist.look_at,
            own_topics={rosout.TOPIC: rosout.header(standard_definitions())}
            if settings.monitors_on_rosout
            else {},
            own_call=self._own_call,
            relay_all=settings.relaying == "all",
            stand_ins=settings.mediation == "full",
        )
        limits = limits_of_answers(value_limits(settings), int(settings.limits.parameter_bytes))
        self.rosmaster = RosMaster(settings.rosmaster_port, limits=limits)
        self.faces = ProxyEndpoints(
            registry, self.places, inner_port=self.port(INNER), server=self.listener_limits.server
        )
        self.entries = MasterRegistrations(self.rosmaster, registry, self.faces.inner_uri)
        self.subscribers = Subscribers(
            registry,
            self.grants,
            self.relay,
            Delivery(nodes, troubled=self.watchlist.could_not_tell, quota_class=self.quota_class),
            self._tree,
            may_read_value=self.rights.may_read_value,
            may_know_value=self.rights.may_know_value,
        )
        stored = StoredGraph(self.grants, self.store)
        self.sinks = Sinks(registry, (stored, self.subscribers, self.entries, self.relay, self.faces))
        self.monitor_call_gate = MonitorCallGate(
            registry,
            self.graph,
            self.sinks.flush,
            self.policy,
            self.trail,
            self.relay,
            settings.publish_as,
            own_host(address),
        )
        self.enforcement = Enforcement(self.revocation, self.sinks.flush, self.relay, self.places)
        self.inner = MasterSideApi(registry)
        self.liveness = Liveness(
            registry,
            self.graph,
            self.revocation,
            self.subscribers,
            self.watchlist,
            nodes=nodes,
            settings=settings.liveness,
            quota_class=self.quota_class,
            refusals=_REFUSALS_OF_A_ROBOT if self.role.paired else _REFUSALS,
            shut_out=self.role.in_doubt,
            connects=self.carried.connects,
            own_silent=lambda: self.lifeline.say(messages.NodeSilent("rosout")),
        )

    def _own_call(self, asked: OwnCall) -> Awaitable[OwnAnswer]:
        match asked:
            case messages.MonitorCallWanted():
                return self.monitor_call_gate.answer(asked)
            case messages.OwnServiceCalled():
                return self.own_services.called(asked)
            case _:
                return self.calls.request(asked)

    def _make_policies(self) -> None:
        self._robot = robot_addresses(self.settings, self.role.robot)
        self.policies = Policies(
            self.settings.policy,
            self.store,
            self.ends,
            self.trail,
            self.policy,
            known=self._policy_context,
            live=self.revocation.live,
            changed=self._policy_changed,
            carried_out=self.relay.carried_out,
        )
        self.policy_facts = PolicyFacts(self.policies, lambda host: charged_to(self.policies.current, host))

    def _policy_context(self) -> PolicyContext:
        known = replace(
            IN_CONTROL,
            hosts=dict(self.hosts.tunnels.addresses),
            robot=self._robot,
            own=frozenset(self.lifeline.surroundings.machine),
            site_keys=self.settings.site_keys,
            blocks=self.hosts.blocks.reasons,
            now=self.ends.system_time(),
            ends=passed_changes(self.ends),
        )
        return self.policy_facts.added_to(known)

    def _policy_changed(self, _before: Policy, policy: Policy) -> int:
        for listener in self.policy_facts.listeners:
            listener()
        return self.enforcement.policy_changed(policy)

    def _make_calls(self) -> None:
        """Make the calls of RVMaster: their way from a host to an answer, and the parts that carry them out."""
        settings, trail, registry, relay = self.settings, self.trail, self.registry, self.relay
        offload, port = int(settings.limits.offload_bytes), self.port(RVMASTER)
        self.reminders = Reminders(registry, self.subscribers.absent, self.subscribers.renew)
        self.role.on_end_of_gap(self.reminders.begin)
        self.parameter_calls = ParameterCalls(
            self.rosmaster, self.parameters, self.subscribers.parameter_set, self.rights, offload
        )
        execution = Execution(
            gate=self.call_gate,
            policy=self.policy,
            trail=trail,
            registry=registry,
            flush=self.sinks.flush,
            liveness=self.liveness,
            parameters=self.parameter_calls,
            redecide_for=self.enforcement.redecide_for,
            hold_call=self.calls.call,
            large=offload,
            large_writes=LargeWrites(offload, self.quota_class, self.role.before_answer),
        )
        self.pipeline = Pipeline(
            execution,
            Multicall(execution, self.parameter_calls, trail, offload=offload),
            addresses=self.addresses,
            trail=trail,
            limits=value_limits(settings),
            offload=offload,
            bulk=bulk_turns(self.quota_class),
            processor=self.listener_limits.time,
            before_answer=self.role.before_answer,
        )
        node_calls = NodeCalls(
            registry, self.graph, relay, self.addresses, relay.nodes, self.liveness, self.call_gate, port
        )
        self.serve_node = partial(self.pipeline.handler, served_calls(NODE_CALLS.values(), node_calls))
        arrivals = Arrivals(
            registry,
            self.graph,
            self.sinks.flush,
            self.liveness,
            places=self.places,
            faces=self.faces,
            addresses=self.addresses,
            serve=self.serve_node,
        )
        registration = RegistrationCalls(
            registry, self.graph, arrivals, relay, self.parameter_calls, self.subscribers
        )
        self.publisher = OwnPublisher(
            registry,
            self.graph,
            registration,
            name=settings.publish_as,
            inner_port=self.port(INNER),
            wanted=lambda: (
                {topic: header.type for topic, header in relay.own_topics.items()}
                | self.monitors.checked.publications
            ),
            services=settings.own_services,
        )
        self.monitors = self._make_monitors()
        self.monitor_calls = MonitorCalls(self.monitors, registry, relay, self.rosmaster.port, port)
        lookups = LookupCalls(
            registry,
            self.graph,
            relay,
            self.addresses,
            port,
            stop=lambda reason: self.lifeline.say(messages.ApplianceStopRequested(reason)),
            unseen=settings.publish_as if settings.hide_publisher else None,
        )
        self.reconciler = Reconciler(
            self.rosmaster,
            self.entries,
            registry,
            self.subscribers,
            self.parameters,
            trail,
            own_parameters=own_parameters,
        )
        self.table = master_table(registration, lookups, self.parameter_calls, self.monitor_calls)

    def _make_monitors(self) -> SpecificationManager:
        settings, compiler = self.settings, self.compiler
        log = rosout.Rosout(
            settings.publish_as,
            self.relay.publish,
            lambda name: self.monitors.checked.monitors.get(name, ""),
        )
        return SpecificationManager(
            settings.monitors,
            settings.enable,
            self.store,
            self.ends,
            self.trail,
            on_fault=settings.on_fault,
            slices=settings.slices,
            allocation=self.relay.allocation,
            relays=RelayMoves(self.relay, self.subscribers, self.reminders),
            published=self.publisher.wake,
            told=[log.reported] if settings.monitors_on_rosout else [],
            site_keys=settings.site_keys,
            check=compiler.check,
            check_at_start=compiler.check_at_start,
            try_out=compiler.try_out,
            parts=compiler.parts,
            live=lambda: published_now(self.registry, self.carried),
        )

    # --- operators and features ---

    def _make_queries(self) -> None:
        self.features = FeatureParts()
        sessions, around = Provided[Sessions](), self.lifeline.surroundings
        self.tokens = TokenOrders(self.store, self.trail, self.ends, self._state_tokens, sessions=sessions)
        self.bearers = Bearers(self.tokens.usable, self._state_tokens, sessions)
        self.clock = ClockCheck(self.trail, lambda: self.audit.ids.ahead, stepped=self._clock_stepped)
        self.ends.when_cut_short(self.clock.cut_short)
        self.switched_off = SwitchedOffWatch(
            lambda: self.monitors.switches.switched_off(),  # noqa: PLW0108  of those in force then
            self.monitors.until,
            self.policy,
            store=self.store,
            trail=self.trail,
            forgotten_after=self.settings.forgotten_after,
        )
        self.handled = HandledAlarms(self.store, self.ends)
        self.state_age = StateAge(self.store, self.trail)
        self.queries = Queries(
            self.registry,
            self.relay,
            self.rosmaster,
            self.monitors,
            self.trail,
            self.policies,
            self.hosts,
            around,
            rv_state=self.monitor_calls.rv_state,
            features=self.features.status,
            audit=self._audit_state,
            clock=self.clock.state,
            queued_deliveries=lambda: self.subscribers.delivery.waiting,
            live=self.revocation.live,
            switched_off=self.switched_off.rows,
            blocks=self.hosts.blocks.state,
            handled=self.handled.with_marks,
            new_state=self.state_age.state,
            tokens_ending=self.tokens.ending,
            name=self.settings.name,
        )

    def _state_tokens(self) -> None:
        self.rest.state_tokens()

    def _clock_stepped(self) -> None:
        self.hosts.tunnels.state_anew()
        self.policies.time_passed()

    def _audit_state(self, states: dict[str, Any]) -> AuditState:
        return AuditState(
            *self.audit.lag,
            failed=self.audit.failed,
            on_failure=self.settings.audit.on_audit_failure,
            degraded=self.audit.degraded,
            replaced=self.audit.replaced,
            **states,
        )

    def _make_core(self) -> None:
        registry, delivery = self.registry, self.subscribers.delivery

        def host_of(node: str) -> Address | None:
            return None if (holder := registry.holder(node)) is None else holder.host

        def name_of(key: str) -> str:
            return "" if (node := registry.by_key(key)) is None else node.name

        self.core = Core(
            settings=self.settings,
            role=self.role,
            trail=self.trail,
            store=self.store,
            ends=self.ends,
            links=Links(self.lifeline, self.receipts.received),
            policy=self.policy_facts,
            specifications=self.monitors,
            hosts=self.hosts,
            graph=GraphFacts(
                present=partial(graph_of, registry, self.relay),
                topic=partial(topic_of, registry, self.relay),
                host_of=host_of,
                name_of=name_of,
                machines=registry.machines,
                connected=partial(hosts_connected, registry, self.carried),
                live_rights=self.revocation.live,
                expel=self.enforcement.expel,
                signs=host_signs(registry, self.carried),
                master_port=self.port(RVMASTER),
                connections=NodeConnections(registry, delivery, self.lifeline.surroundings),
                registrar=self._registrar(),
            ),
            relay=RelayOrders(self.relay, self.calls, self.publisher.wake),
            rest=RestServices(),
            own_services=self.own_services,
            bearers=self.bearers,
            limits=ResourceUses(
                OwnUses(
                    registry,
                    self.carried,
                    lambda: self.places.taken,
                    self.listener_limits.connection_table.connected,
                    self.parameters.charges.pool,
                    self.settings,
                )
            ),
            alarms=Alarms(self.queries.present, self.handled),
        )

    def _registrar(self) -> Registrar:
        async def call(host: Address, local: str, method: str, values: tuple[Value, ...]) -> Value:
            peer = Peer(host, str(host), local)
            return await self.pipeline.run_order(self.table, peer, MethodCall(method, values))

        def silence() -> None:
            self.reminders.close()
            self.subscribers.delivery.silence()

        def speak() -> None:
            self.subscribers.delivery.speak()
            self.subscribers.remind_all()

        return Registrar(
            registry=self.registry,
            graph=self.graph,
            subscribers=self.subscribers,
            parameters=self.parameter_calls,
            flush=self.sinks.flush,
            call=call,
            ready=self.reconciler.ready.wait,
            silence=silence,
            speak=speak,
        )

    def take_orders(self) -> None:
        """Make the parts that take orders, once each feature has begun."""
        methods = request_methods(
            queries=self.queries, policies=self.policies, monitors=self.monitors, tokens=self.tokens
        )
        self.administration = Administration(
            self.features.methods() + methods,
            in_force=lambda: (self.policies.revision, self.monitors.revision),
            durable=self._durable,
            require_room=self.store.database.require_room,
            obstacle=lambda: self.trail.obstacle,
        )
        blocks = self.hosts.blocks
        uses = RestUses(lambda: blocks.reasons)
        blocks.uses.add(uses.of)
        blocks.on_change(self._state_tokens)
        self.rest = RestLink(
            self.administration,
            self.tokens,
            self.trail,
            served=self.hosts.enrolment.served_by,
            certified=RestCertificate(self.store, self.trail, self.role.name).stated,
            connected=self.core.rest.accept_websocket,
            require_proof=self.settings.api_require_proof,
            uses=uses,
        )

    async def _durable(self) -> None:
        await self.trail.durable()
        if self.role.before_answer is not None:
            await self.role.before_answer()
