"""Take a graph over from the robot's own master, and give it back.

Both are sequences of steps. Each step can be repeated, so a start after a kill runs the sequence again from its
beginning. `passed` is called after each step.

Taking: read, register, forward 11311, tell subscribers, cut, and read again until two readings are equal: a node that
starts in the meantime registers at the master that it still finds, and sets its parameters there.

1. Publishers are registered before services, and services before subscribers.
2. The rules come after the first registrations; before, calls of the robot would find an empty graph.
3. Only ports of registered nodes are cut, and only ports on which the node's own process listens. Any host may have
   registered a service for a node, so its port is cut if the node tells that port for its topics, or if the service
   itself answers there.
4. The phase says that a graph is being taken before the first registration: from then on RVMaster may tell nodes its
   own lists, above all a control that starts again, so only giving back ends it.
5. In the phase `taken`, and with the graph on the disk, the robot's own master loses the adopted subscriptions: it then
   sends no list to a node, even if other machines reach it because a program flushed the rules. A subscription that is
   absent there says nothing about its node. Giving back registers each again.

Giving back: silence, a master, registrations, forward no more, registrations once more, tell subscribers, cut, forget.
Another master than the recorded one gets nothing: nodes keep their topics by RVMaster's own lists.

6. Nothing of RVMaster reaches a node after the silence: the other master's list is the last one that a node gets.
7. A node that was registered with another URI is unregistered first, because `rosmaster` sends a shutdown request to
   the earlier URI of a name.
8. From the end of the forwarding on, nodes start at their own master. A name that came there since is neither ended nor
   registered again, unless RVMaster's node of that name still answers. The same holds for a graph that was not yet
   taken over completely.

After each cut, subscribers get their list once more. roscpp keeps a connection that it was making when a list came,
even if the list lacks its publisher. Once that connection is cut and refused, it is dead, but a later list with this
publisher changes nothing; only a list without it removes it.
"""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import msgspec

from appliance.base import clock
from appliance.base.actors import OPERATOR
from appliance.base.counted import counted
from appliance.features.adopt.adopt_answers import GiveBackReport, TakeOverReport
from appliance.features.adopt.adopt_record import Phase
from appliance.features.adopt.graph_side import CLOCK, AdoptedGraph, service_text
from appliance.features.adopt.machine_facts import FIRST_PORT, MachineFacts
from appliance.features.adopt.places import (
    MAX_FAILED,
    TOPIC_SECONDS,
    NodeCaller,
    NodePlace,
    Places,
    ServiceProbe,
    call_node,
    find_places,
    has_service,
    names_to_resolve,
    parse_places,
)
from appliance.features.adopt.subscriber_lists import (
    Subscription,
    lists_of,
    reconnect,
    send_lists,
    until_connected,
    until_least,
)
from appliance.master.graph.registry import Incarnation
from appliance.rpc.host_shares import HostShare, serve_by_host
from appliance.rpc.master_reader import (
    ORDER,
    PUBLICATION,
    SERVICE,
    SUBSCRIPTION,
    Entry,
    MasterCall,
    MasterGraph,
    MasterReader,
    MasterReadError,
)
from appliance.rpc.xmlrpc_client import CallFailedError, UnansweredError
from appliance.supervisor.machine_work import Found
from roswire.names import ROSOUT
from roswire.parameter_tree import merge, same_value
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

MASTER_NAME = "/master"
LAST_WORD_SECONDS = 5.0  # an ordered end of the appliance waits 10 s for the whole
_READINGS = 5
_LISTS_SECONDS = 2.0
_BESIDES_SECONDS = 1.0  # for the lists before and after the last one
_REMINDERS = 2
_PAUSE_SECONDS = 0.02
_SHOWN = 3
_TOPICS_ASKED = 5
_NEWER_SECONDS = 3.0
_AT_ONCE = 50  # registrations without a pause for other callers
_MAX_SHOWN = 50  # registrations in a record
_OWN_MASTER_SECONDS = 30.0
_KEPT_PARAMETER = "run_id"
_OWN_PARAMETERS = frozenset({"run_id", "rosdistro", "rosversion"})  # each master has its own, from roslaunch
_REGISTER = {PUBLICATION: "registerPublisher", SUBSCRIPTION: "registerSubscriber", SERVICE: "registerService"}
_UNREGISTER = {
    PUBLICATION: "unregisterPublisher", SUBSCRIPTION: "unregisterSubscriber", SERVICE: "unregisterService",
}  # fmt: skip


HeldNode = tuple[Incarnation, set[Entry]]
T = TypeVar("T")


class AdoptError(Exception):
    """The graph cannot be taken over, or given back; the message says why."""


class MachineOrders(Protocol):
    """Does the supervisor's work. Raises `AdoptError`."""

    async def __call__(self, work: str, /, **terms: object) -> Found: ...


class CutConnections(msgspec.Struct):
    """The numbers of ended connections to a master and of nodes, and the processes that kept theirs, by their ports."""

    master: int = 0
    nodes: int = 0
    kept: dict[str, str] = {}


class ParameterSide(Protocol):
    """RVMaster's parameters."""

    def tree(self) -> Mapping[str, Value]: ...

    async def take(self, values: Mapping[str, Value]) -> dict[str, str]:
        """Set parameters, and delete those without a value; return the names of those that a limit left out, with the
        reason.
        """


async def _nothing(_step: str) -> None: ...


async def _stored() -> bool:
    return True


@dataclass
class LastWord:
    """The last list of each subscriber, and the names of the nodes that did not take one."""

    lists: dict[Subscription, list[str]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def of_nodes_that_answer(self) -> dict[Subscription, list[str]]:
        return {row: uris for row, uris in self.lists.items() if row[0].name not in self.failed}

    def wanted_uris(self, rows: Iterable[Subscription]) -> dict[Subscription, set[str]]:
        """Return the URIs to which each of these shall connect; a node connects to itself without a socket."""
        wanted = {row: {*self.lists[row]} - {row[0].api_text} for row in rows}
        return {row: uris for row, uris in wanted.items() if uris}


@dataclass
class LeftThere:
    """Nodes, by name with the reason, and names of parameters that stay with the robot's own master only.

    `connections` has the ports whose connections were not cut, with the process that does not look like a node.
    """

    nodes: dict[str, str] = field(default_factory=dict)
    parameters: set[str] = field(default_factory=set)
    connections: dict[str, str] = field(default_factory=dict)
    untold: dict[str, str] = field(default_factory=dict)
    """Nodes of other computers whose connections were not cut, because they do not tell the port of their topics."""

    @property
    def not_cut(self) -> dict[str, str]:
        return dict(sorted((self.connections | self.untold).items()))


@dataclass
class AdoptOperation:
    """The sequences. `waiting()` counts the calls that wait for nodes.

    `stored` waits until the graph is on the disk, and returns whether it is. `forwards` is false if the nodes reach
    their own master already, because the appliance is dead.
    """

    machine: MachineOrders
    reader: Callable[[MachineFacts], MasterReader]
    graph: AdoptedGraph
    parameters: ParameterSide
    waiting: Callable[[], int]
    silence: Callable[[], None]
    speak: Callable[[], None]
    call: NodeCaller = call_node
    probe: ServiceProbe = has_service
    forwards: bool = True
    passed: Callable[[str], Awaitable[None]] = _nothing
    stored: Callable[[], Awaitable[bool]] = _stored
    left: LeftThere = field(default_factory=LeftThere)
    _who: str = field(default="", init=False)
    _hidden: bool = field(default=False, init=False)
    _facts: MachineFacts = field(init=False)
    _taking: asyncio.Timeout | None = field(default=None, init=False)
    _ends: bool = field(default=False, init=False)
    _read_there: dict[str, Value] = field(default_factory=dict, init=False)
    """The parameters of the robot's own master, as RVMaster has taken them, until the graph is taken."""

    async def facts(self, nodes: Iterable[NodeUri] = ()) -> MachineFacts:
        uris = list(nodes)
        ports = sorted({uri.port for uri in uris})
        found = await self.machine("look", ports=ports, names=names_to_resolve(uris))
        self._facts = msgspec.convert(found, MachineFacts, strict=False)
        return self._facts

    def _share(self, node: Incarnation) -> str:
        return _place_of(node).share(self._facts)

    async def settle(self, facts: MachineFacts, *, settled: bool) -> TakeOverReport | GiveBackReport | None:
        """Bring the graph to what the record wants; `settled`: this process has done so already.

        Raises `AdoptError`.
        """
        wanted, phase = facts.record.wanted, facts.record.phase
        if wanted and (phase is not Phase.TAKEN or not settled):
            return await self.take()
        if not wanted and phase is not Phase.FREE:
            return await self.give()
        if wanted:
            async with self._until_end():
                await self._take_missing(facts)
                await self._cut_untold()
                if not self._hidden:
                    await self._try(self._clear_master(facts))
                    await self._try(self._hide_subscribers(facts))
        return None

    def end(self) -> None:
        """End a taking where it is, and let none begin any more; giving back is still possible."""
        self._ends = True
        if self._taking is not None:
            self._taking.reschedule(0.0)

    @asynccontextmanager
    async def _until_end(self) -> AsyncIterator[None]:
        """Take until `end`, as until a kill, but each change of RVMaster is made to its end. Raises `AdoptError`."""
        try:
            if self._ends:
                raise TimeoutError
            async with asyncio.timeout(None) as self._taking:
                yield
        except TimeoutError:
            if self._ends:
                raise AdoptError("the appliance ends") from None
            raise
        finally:
            self._taking = None

    # --- taking over ---

    async def adopt(self) -> TakeOverReport:
        """Take the graph over by an order, and at each start from now on.

        Raises `AdoptError`. The order then has no later effect: the graph stays with the robot's master, or goes back.
        """
        wanted = (await self.facts()).record.wanted
        await self.machine("want", wanted=True)
        self._who = OPERATOR
        try:
            return await self.take()
        except AdoptError as error:
            if not wanted:
                await self._withdraw_order(error)
            raise
        finally:
            self._who = ""

    async def release(self) -> GiveBackReport:
        """Give the graph back by an order, for good. Raises `AdoptError`; `settle` then tries again."""
        facts = await self.facts()
        if facts.record.phase is Phase.TAKEN:
            with suppress(AdoptError):
                async with self._until_end():
                    await self._take_missing(facts)  # so that they get their lists with the others
        await self.machine("want", wanted=False)
        if facts.record.phase is Phase.FREE:
            return GiveBackReport()
        self._who = OPERATOR
        try:
            return await self.give()
        finally:
            self._who = ""

    async def _withdraw_order(self, error: AdoptError) -> None:
        try:
            await self.machine("want", wanted=False)
            if (await self.facts()).record.phase is not Phase.FREE:
                await self.give()
        except AdoptError as second:
            raise AdoptError(f"{error}; the graph is not given back yet: {second}") from None

    async def take(self) -> TakeOverReport:
        """Take the graph over. Raises `AdoptError` if the present master is not the recorded one, or cannot be read."""
        async with self._until_end():
            return await self._take()

    async def _take(self) -> TakeOverReport:
        began, facts = clock.now(), await self.facts()
        if facts.foreign_master:
            raise AdoptError(facts.foreign_master)
        warm = facts.record.phase is Phase.TAKEN
        graph, places, cut, readings, parameters_left = MasterGraph(), Places(), 0, 0, list[str]()
        reads = facts.master is not None and not warm
        if warm:
            places = await self._known_places(facts)
        else:
            if reads:
                graph, places, parameters_left = await self._read_first(facts)
            await self.machine("phase", phase=Phase.TAKING)
        if reads:
            await self._register(graph, places, MasterGraph())
            await self.passed("register")
        self.left.connections.clear()
        cuts = await self._cuts(graph, places)
        await self.machine("forward")
        await self.passed("forward")
        while True:
            if reads and not readings:
                await self._connect(graph, places)
            await self._tell(places)
            await self.passed("tell")
            cut += await self._cut(cuts)
            await self._tell(places)
            await self._tell_clock(places)
            await self.passed("cut")
            readings += 1
            if not reads:
                break
            parameters_left += await self._take_parameters(facts)  # no node reaches that master any more
            again, places = await self._read(facts, (graph, places))
            same = again.registered == graph.registered
            if not same:
                await self._register(again, places, graph)
                cuts = await self._cuts(again, places)
            graph = again
            await self.passed("read again")
            if same:
                break
            if readings >= _READINGS:
                raise AdoptError(
                    f"the graph still changes after {readings} readings: wait until all nodes have started"
                )
        await self._note_taken(facts)
        report = self._report(cut, readings, [*graph.left_out, *parameters_left], clock.now() - began)
        if reads:
            self._record(report)
        await self.passed("taken")
        return report

    async def _read_first(self, facts: MachineFacts) -> tuple[MasterGraph, Places, list[str]]:
        graph, places = await self._read(facts)
        await self.passed("read")
        if facts.record.phase is not Phase.FREE:  # a kill came after RVMaster had the parameters
            return graph, places, []
        if places.own and not self._who:
            listed = "; ".join(f"{name}: {why}" for name, why in sorted(places.own.items())[:_SHOWN])
            raise AdoptError(
                f"{counted(len(places.own), 'node')} of this computer cannot be called: {listed}. The graph stays with"
                " the robot's own master, and is read again in seconds; `rosrv adopt` takes the other nodes"
            )
        left = await self._take_parameters(facts, first=True)
        await self.passed("parameters")
        return graph, places, left

    async def _read(
        self, facts: MachineFacts, before: tuple[MasterGraph, Places] | None = None
    ) -> tuple[MasterGraph, Places]:
        """Return the graph, and the places of its nodes; those of the reading before are not asked again."""
        try:
            graph = await self.reader(facts).read()
        except MasterReadError as error:
            raise AdoptError(f"the robot's master cannot be read: {error}") from None
        nodes = {name: uri for name, uri in graph.nodes.items() if not self.graph.is_own(name)}
        earlier, known = before or (MasterGraph(), Places())
        new = {name: uri for name, uri in nodes.items() if earlier.nodes.get(name) != uri}
        uris, _invalid = parse_places(new)
        places = await find_places(new, await self.facts(uris.values()), self.call)
        for name in nodes.keys() - new.keys():
            if name in known.found:
                places.found[name] = known.found[name]
            else:
                places.missing[name] = known.missing[name]
        self.left.nodes = places.missing
        return graph, places

    async def _known_places(self, facts: MachineFacts) -> Places:
        """Return the nodes that RVMaster has from before a restart, or a removal of the firewall's rules."""
        await self._try(self._clear_master(facts))
        return _places_of(node for node in self.graph.nodes() if node in self.graph.subscribers.unasked)

    async def _take_parameters(self, facts: MachineFacts, *, first: bool = False) -> list[str]:
        """Take the parameters of the robot's own master; later what changed there since, and not at RVMaster."""
        try:
            there = await self.reader(facts).parameters()
        except MasterReadError as error:
            raise AdoptError(f"the robot's parameters cannot be read: {error}") from None
        mine = self.parameters.tree()
        if first:
            kept = self.graph.nodes() and _KEPT_PARAMETER  # a node of RVMaster may have read it
            self._read_there = {name: value for name, value in mine.items() if name in there and name != kept}
            self.left.parameters = set()
        wanted = merge(self._read_there, there, mine)
        left = await _whole(self.parameters.take({
            name: wanted.get(name) for name in {**mine, **wanted} if not same_value(wanted.get(name), mine.get(name))
        }))  # fmt: skip
        self._read_there = deepcopy(there)
        self.left.parameters |= set(left)
        return [f"parameter /{name}: {why}" for name, why in left.items()]

    async def _register(self, graph: MasterGraph, places: Places, before: MasterGraph) -> None:
        for number, entry in enumerate(graph.in_order()):
            place = places.found.get(entry[2])
            if place is not None:
                await _whole(self.graph.register(entry, place, graph))
            if number % _AT_ONCE == 0:
                await asyncio.sleep(0)
        for entry in before.in_order():
            place = places.found.get(entry[2])
            if entry not in graph.entries and place is not None:
                await _whole(self.graph.unregister(entry, place, before))

    async def _tell(self, places: Places) -> None:
        self.graph.tell(places.found)
        await self._until_told()

    async def _tell_clock(self, places: Places) -> None:
        """Give subscribers of simulated time their list once their earlier connections have ended."""

        async def tell(row: Subscription) -> None:
            self.graph.remind(*row)

        self.left.connections |= await reconnect(
            self.call, self._share, self.graph.clocks(places.found), tell
        )
        await self._until_told()

    async def _until_told(self) -> None:
        until = clock.now() + _LISTS_SECONDS
        while self.waiting() and clock.now() < until:
            await asyncio.sleep(_PAUSE_SECONDS)

    async def _take_missing(self, facts: MachineFacts) -> None:
        """Take nodes over that did not answer before, for example because they hung. Raises `AdoptError`.

        A name that RVMaster has by now belongs to a later node.
        """
        missing = {name for name in self.left.nodes if self.graph.registry.occupant(name) is None}
        if not missing or facts.master is None or facts.foreign_master:
            return
        before = self.left.nodes
        graph, places = await self._read(facts)
        late = Places({name: place for name, place in places.found.items() if name in missing})
        self.left.nodes = {
            name: places.missing.get(name, why)
            for name, why in before.items()
            if name in graph.nodes and name not in late.found
        }
        if not late.found:
            return
        entries = frozenset(entry for entry in graph.entries if entry[2] in late.found)
        own = MasterGraph(entries, graph.types, graph.nodes, graph.services)
        await self._register(own, late, MasterGraph())
        cuts = await self._cuts(own, late)
        await self._connect(graph, late)
        await self._tell(late)
        await self._cut(cuts)
        await self._tell(late)
        await self._tell_clock(late)
        self._hidden = False
        await self.passed("missing nodes")

    async def _note_taken(self, facts: MachineFacts) -> None:
        await self.machine("phase", phase=Phase.TAKEN)
        self._hidden, self._read_there = False, {}
        await self._try(self._hide_subscribers(facts))

    @staticmethod
    async def _try(work: Awaitable[None]) -> None:
        """Do work at the robot's own master; if that does not answer, `settle` tries again."""
        with suppress(MasterReadError, TimeoutError):
            async with asyncio.timeout(_OWN_MASTER_SECONDS):
                await work

    async def _clear_master(self, facts: MachineFacts) -> None:
        """Undo what was registered at the robot's own master only: other machines may have reached it.

        A node of this machine that started in the meantime is taken over. Parameters get the present values.
        """
        if facts.master is None or facts.foreign_master:
            return
        began, reader = clock.now(), self.reader(facts)
        there = await reader.read()
        begun = await self._take_begun(there)
        held = dict(self.graph.all_registrations())
        unknown = [entry for entry in there.in_order() if self._is_gone(entry, there, held)]
        await reader.ask_all([_unregistration(entry, there) for entry in unknown])
        await self._give_parameters(reader, complete=False)
        if unknown or begun:
            self.graph.trail.happened(
                "graph restored",
                f"unregistered {counted(len(unknown), 'registration')} that only the robot's own master had; took over"
                f" {counted(len(begun), 'node')} of this machine",
                unregistered=[f"{' '.join(entry)} {there.nodes.get(entry[2], '')}" for entry in unknown[:_MAX_SHOWN]],
                nodes=begun or None, seconds=round(clock.now() - began, 2),
            )  # fmt: skip

    async def _take_begun(self, there: MasterGraph) -> list[str]:
        """Take over the nodes of this machine that registered at their own master only; return their names."""
        held = {node.api_text for node in self.graph.nodes()}
        uris, _invalid = parse_places({
            name: uri for name, uri in there.nodes.items()
            if uri not in held and not self.graph.is_own(name) and self.graph.registry.occupant(name) is None
        })  # fmt: skip
        facts = await self.facts(uris.values())
        begun = [name for name, uri in uris.items() if facts.has_node(uri)]
        if begun:
            self.left.nodes |= dict.fromkeys(begun, "it started while the firewall's rules were removed")
            await self._take_missing(facts)
        return [name for name in begun if name not in self.left.nodes]

    async def _hide_subscribers(self, facts: MachineFacts) -> None:
        """Unregister the adopted subscriptions at the robot's own master, once they are on the disk here."""
        if facts.master is None or facts.foreign_master or not await self.stored():
            return
        reader, held = self.reader(facts), dict(self.graph.all_registrations())
        there = await reader.read()
        adopted = [
            entry for entry in there.in_order()
            if entry[0] == SUBSCRIPTION and entry in held and not self._is_gone(entry, there, held)
        ]  # fmt: skip
        await reader.ask_all([_unregistration(entry, there) for entry in adopted])
        self._hidden = True
        await self.passed("hidden")

    async def _cut_untold(self) -> None:
        """Ask nodes again that did not tell the port of their topics, and cut these. Raises `AdoptError`."""
        nodes = [node for node in self.graph.adopted_nodes() if node.name in self.left.untold]
        self.left.untold = {node.name: self.left.untold[node.name] for node in nodes}
        if nodes:
            places = _places_of(nodes)
            cuts = await self._cuts(MasterGraph(), places)
            await self._tell(places)
            await self._cut(cuts)
            await self._tell(places)

    async def _cut(self, cuts: Mapping[str, object]) -> int:
        done = msgspec.convert(await self.machine("cut", **cuts), CutConnections)
        self.left.connections.update(done.kept)
        return done.master + done.nodes

    async def _connect(self, graph: MasterGraph, places: Places) -> None:
        """Have the nodes connect through the appliance; until that stands, they keep their earlier connections."""
        self.graph.tell(places.found, lists_of(graph))
        await self._until_told()
        await until_least(self.graph.absent)
        await self.passed("connect")

    async def _cuts(self, graph: MasterGraph, places: Places) -> dict[str, object]:
        """Return the ports to cut, found before subscribers get their lists: rospy hears twice until the cut.

        A node of this computer that does not tell the port of its topics loses its connections at all ports of its
        process. One of another computer is named, and asked again with the missing nodes.
        """
        nodes = {name: place for name, place in places.found.items() if self._registered(name, place)}
        facts = await self.facts(place.uri for place in nodes.values())
        told = await self._topic_ports(graph, nodes, facts)
        served = await self._service_ports(graph, nodes, facts, told)
        apis, master = {place.uri.port for place in nodes.values()}, self.reader(facts).uri
        ports: set[int] = set()
        remote: set[tuple[str, int]] = set()
        for name, place in nodes.items():
            port = told.get(place.call_uri, 0)
            offered = {port or 0, *served.get(place.call_uri, ())} - {0}
            self.left.untold.pop(name, None)
            if place.is_here(facts):
                listening = set(facts.sockets.get(place.uri.port, []))
                ports |= (listening if port is None else listening & offered) - apis
            elif place.host.version == 4:
                remote |= {(str(place.host), one) for one in offered - {place.uri.port}}
                if port is None:
                    self.left.untold[name] = (
                        f"it did not tell the port of its topics within {TOPIC_SECONDS:g} s"
                    )
        return {
            "ports": sorted(port for port in ports if port >= FIRST_PORT and port != master.port),
            "remote": sorted(row for row in remote if row[1] >= FIRST_PORT and row[1] != master.port),
        }

    def _registered(self, name: str, place: NodePlace) -> bool:
        node = self.graph.node_at(name, place)
        return node is not None and bool(node.registrations)

    async def _service_ports(
        self,
        graph: MasterGraph,
        nodes: Mapping[str, NodePlace],
        facts: MachineFacts,
        told: Mapping[NodeUri, int | None],
    ) -> dict[NodeUri, set[int]]:
        """Return the ports that answer as a service of each place, besides the one that it told for its topics.

        Each place has a share of its own. A service that does not answer in time is named as not cut.
        """
        shares: dict[tuple[NodeUri, int, str], str] = {}
        for kind, service, name in self._entries(graph):
            if name not in nodes or kind != SERVICE:
                continue
            place, port = nodes[name], self._service_port(graph, service, name)
            here = port in facts.sockets.get(place.uri.port, ()) or not place.is_here(facts)
            if port >= FIRST_PORT and here and port not in {place.uri.port, told.get(place.call_uri)}:
                shares[place.call_uri, port, service] = f"{place.host}:{place.uri.port}"
        served: dict[NodeUri, set[int]] = {}
        failed = Counter[str]()

        async def ask(row: tuple[NodeUri, int, str]) -> None:
            uri, port, service = row
            if port in served.get(uri, ()) or failed[shares[row]] >= MAX_FAILED:
                return
            try:
                if await self.probe(NodeUri("rosrpc", uri.host, port, "/"), service):
                    served.setdefault(uri, set()).add(port)
                    return
            except UnansweredError as error:
                self.left.connections[f"{uri.host} TCP {port}"] = str(error)
            failed[shares[row]] += 1

        seconds = TOPIC_SECONDS + 1
        await serve_by_host(shares, ask, HostShare(seconds, seconds))
        return served

    async def _topic_ports(
        self, graph: MasterGraph, nodes: Mapping[str, NodePlace], facts: MachineFacts
    ) -> dict[NodeUri, int | None]:
        """Return the port of the topics of each place with publications; None if it does not tell one.

        Any host may have registered a topic that the node does not publish. So `/rosout`, which nearly each node
        publishes, is asked for first, and then some others.
        """
        topics: dict[NodeUri, list[str]] = {}
        shares: dict[NodeUri, str] = {}
        for kind, resource, name in sorted(self._entries(graph), key=lambda entry: entry[1] != ROSOUT):
            if name in nodes and kind == PUBLICATION:
                place = nodes[name]
                topics.setdefault(place.call_uri, []).append(resource)
                shares[place.call_uri] = place.share(facts)

        async def ask(uri: NodeUri) -> int | None:
            for topic in topics[uri][:_TOPICS_ASKED]:
                try:
                    answer = await self.call(uri, "requestTopic", topic, [["TCPROS"]])
                except CallFailedError:
                    return None
                match answer:
                    case [1, _, ["TCPROS", str(), int(port)]] if 0 < port < 65_536:
                        return port
            return None

        seconds = TOPIC_SECONDS + 1
        asked = await serve_by_host(shares, ask, HostShare(seconds, seconds))
        return {uri: asked.get(uri) for uri in shares}

    def _entries(self, graph: MasterGraph) -> Iterable[Entry]:
        return graph.entries or [entry for entry, _node in self.graph.all_registrations()]

    def _service_port(self, graph: MasterGraph, service: str, name: str) -> int:
        uri = graph.services.get(service, "")
        if not uri:
            node = self.graph.registry.holder(name)
            uri = service_text(node, service) if node is not None else ""
        tail = uri.rstrip("/").rpartition(":")[2]
        return int(tail) if tail.isascii() and tail.isdecimal() and int(tail) < 65_536 else 0

    def _report(self, cut: int, readings: int, left_out: list[str], seconds: float) -> TakeOverReport:
        nodes = self.graph.adopted_nodes()
        return TakeOverReport(
            nodes=len(nodes),
            hosts=sorted({str(node.host) for node in nodes}),
            registrations=sum(len(node.registrations) for node in nodes),
            denied={" ".join(entry): why for entry, why in sorted(self.graph.denied.items())},
            missing=dict(sorted(self.left.nodes.items())),
            not_cut=self.left.not_cut,
            cut=cut,
            readings=readings,
            left_out=left_out,
            seconds=round(seconds, 2),
        )

    def _record(self, report: TakeOverReport) -> None:
        self.graph.trail.happened(
            "graph adopted",
            f"{counted(report.nodes, 'node')}, {counted(report.registrations, 'registration')},"
            f" {len(report.denied)} denied; {counted(report.cut, 'connection')} cut",
            nodes=report.nodes, registrations=report.registrations, cut=report.cut,
            denied=len(report.denied), missing=len(report.missing), who=self._who or None,
            not_cut=len(report.not_cut) or None,
        )  # fmt: skip

    # --- giving back ---

    async def give(self) -> GiveBackReport:
        """Give the graph back. Raises `AdoptError`; while the rules are in force, RVMaster then serves on."""
        try:
            return await self._give()
        except MasterReadError as error:
            raise AdoptError(f"the robot's master cannot be read: {error}") from None

    async def _give(self) -> GiveBackReport:
        began, facts = clock.now(), await self.facts()
        self.silence()
        if facts.record.phase is Phase.GIVEN:
            return await self._give_rest(facts, began)
        try:
            await self.passed("silence")
            started = bool((await self.machine("stand in")).get("started"))
            await self.passed("stand in")
            facts = await self.facts()
            if facts.foreign_master and not started:
                return await self._give_topics(facts.foreign_master, began)
            reader = self.reader(facts)
            withdrawn = facts.record.phase is Phase.GIVING  # by a give that a kill ended
            known = None if self.forwards and facts.record.phase is Phase.TAKEN else MasterGraph()
            given, ended, after = await self._give_registrations(reader, known)
            before = deepcopy(dict(self.parameters.tree()))
            parameters = 0 if withdrawn else await self._give_parameters(reader, complete=known is None)
            await self.passed("give")
        except (AdoptError, MasterReadError) as error:
            self.speak()
            raise AdoptError(str(error)) from None
        nodes = self._nodes()
        await self.machine("withdraw")
        await self.passed("withdraw")
        # of calls that were under way
        more = await self._give_registrations(reader, after if known is None else known)
        there = await reader.parameters()
        parameters += await self._set_parameters(reader, there, merge(before, self.parameters.tree(), there))
        await self.passed("give again")
        last = await self._last_word(await reader.read(), nodes)
        await self.passed("tell")
        report = GiveBackReport(
            nodes=len(nodes), given=given + more[0], ended=ended + more[1], parameters=parameters,
            master=str(facts.master or ""), started=started, failed=last.failed, seconds=round(clock.now() - began, 2),
        )  # fmt: skip
        return await self._forget(report, began, last)

    async def _give_rest(self, facts: MachineFacts, began: float) -> GiveBackReport:
        """Go on where a kill came before the nodes were forgotten: the next control has told them its own lists."""
        nodes, last = self._nodes(), LastWord()
        if nodes:
            own = facts.master is not None and not facts.foreign_master
            graph = await self.reader(facts).read() if own else _graph_of(nodes)
            last = await self._last_word(graph, nodes)
        report = GiveBackReport(nodes=len(nodes), master=str(facts.master or ""), failed=last.failed)
        return await self._forget(report, began, last)

    def _nodes(self) -> list[HeldNode]:
        """Return the nodes, those of this machine first."""
        held = list(self.graph.all_registrations())
        nodes = sorted(self.graph.nodes(), key=lambda node: not _place_of(node).is_here(self._facts))
        return [(node, {entry for entry, holder in held if holder is node}) for node in nodes]

    async def _give_topics(self, foreign: str, began: float) -> GiveBackReport:
        """Connect the nodes with one another again. The master there may be hostile, so it gets nothing."""
        nodes = self._nodes()
        graph = _graph_of(nodes)
        await self.machine("withdraw")
        await self.passed("withdraw")
        last = await self._last_word(graph, nodes)
        await self.passed("tell")
        withheld = len(graph.entries)
        report = GiveBackReport(
            nodes=len(nodes), failed=last.failed, withheld=withheld, withheld_from=foreign
        )
        return await self._forget(report, began, last)

    async def _forget(self, report: GiveBackReport, began: float, last: LastWord) -> GiveBackReport:
        """Forget the nodes. The phase keeps a repetition from ending what the robot's own master has by now."""
        await self.machine("phase", phase=Phase.GIVEN)
        await self.passed("given")
        await self.machine("leave")
        lists = last.of_nodes_that_answer()
        clocks = {row: lists.pop(row) for row in [*lists] if row[1] == CLOCK}
        await send_lists(self.call, _BESIDES_SECONDS, self._share, lists)

        async def tell(row: Subscription) -> None:
            await send_lists(self.call, _BESIDES_SECONDS, self._share, {row: clocks[row]})

        await reconnect(self.call, self._share, clocks, tell)
        await self._remind(last, clocks)
        self.graph.forget()
        self.graph.denied.clear()
        self.left, self._read_there = LeftThere(), {}
        await self.passed("forget")
        await self.machine("phase", phase=Phase.FREE)
        report = msgspec.structs.replace(report, seconds=round(clock.now() - began, 2))
        released = report.in_words
        if report.withheld:
            keep = counted(report.nodes, "node keeps its topics", "nodes keep their topics")
            withheld = counted(report.withheld, "registration")
            released = f"{keep}; {withheld} not given back: {report.withheld_from}"
        self.graph.trail.happened(
            "graph released",
            released,
            nodes=report.nodes,
            given=report.given,
            withheld=report.withheld or None,
            who=self._who or None,
        )
        self.speak()
        await self.passed("released")
        return report

    async def _give_registrations(
        self, reader: MasterReader, known: MasterGraph | None
    ) -> tuple[int, int, MasterGraph]:
        """Register what the robot's master lacks, and unregister what is gone.

        Return both numbers, and the graph after it. `known` is the graph since which nodes may have come directly to
        the robot's master; None: none can.
        """
        there, held = await reader.read(), dict(self.graph.all_registrations())
        newer = set[str]() if known is None else await self._newer(there, held, known)
        gone = [
            entry
            for entry in there.in_order()
            if entry[2] not in newer
            and self._is_gone(entry, there, held)
            and (known is None or entry in known.entries or self._moved(entry[2], there, held))
        ]
        new = [entry for entry, node in held.items() if entry[2] not in newer and _is_new(entry, node, there)]
        new.sort(key=lambda entry: (ORDER.index(entry[0]), entry))
        calls = [_unregistration(entry, there) for entry in gone]
        for entry in new:
            kind, resource, name = entry
            node = held[entry]
            detail = (
                service_text(node, resource) if kind == SERVICE else self.graph.registry.type_of(resource)
            )
            calls.append((_REGISTER[kind], name, (resource, detail, node.api_text)))
        await reader.ask_all(calls)
        left = {name: uri for name, uri in there.nodes.items() if name not in newer}
        after = MasterGraph(
            frozenset(entry for entry in there.entries if entry[2] in left).difference(gone).union(new),
            nodes=left | {entry[2]: held[entry].api_text for entry in new},
        )
        return len(new), len(gone), after

    async def _newer(
        self, there: MasterGraph, held: Mapping[Entry, Incarnation], known: MasterGraph
    ) -> set[str]:
        """Return the names that came to the robot's master since, and whose node at RVMaster does not answer."""
        nodes = {entry[2]: node for entry, node in held.items()}

        async def is_newer(name: str) -> bool:
            try:
                await self.call(nodes[name].call_uri, "getPid")
            except CallFailedError:
                return True
            return False

        names = [
            name
            for name, uri in there.nodes.items()
            if known.nodes.get(name) != uri and (name not in nodes or nodes[name].api_text != uri)
        ]
        shares = {name: self._share(nodes[name]) for name in names if name in nodes}
        results = await serve_by_host(shares, is_newer, HostShare(_NEWER_SECONDS, _NEWER_SECONDS))
        return {name for name in names if results.get(name, True)}

    @staticmethod
    def _moved(name: str, there: MasterGraph, held: Mapping[Entry, Incarnation]) -> bool:
        """Return whether RVMaster's node of this name has another URI."""
        return any(
            entry[2] == name and node.api_text != there.nodes.get(name) for entry, node in held.items()
        )

    def _is_gone(self, entry: Entry, there: MasterGraph, held: Mapping[Entry, Incarnation]) -> bool:
        name = entry[2]
        if self.graph.is_own(name) or entry in self.graph.denied or name in self.left.nodes:
            return False
        node = held.get(entry)
        return node is None or there.nodes.get(name) != node.api_text

    async def _give_parameters(self, reader: MasterReader, *, complete: bool) -> int:
        """Set what differs. If RVMaster had all parameters (`complete`), what it lacks was deleted there; else what
        changed at the robot's own master since RVMaster took it stays.
        """
        there = await reader.parameters()
        wanted = merge(there if complete else self._read_there, there, self.parameters.tree())
        return await self._set_parameters(reader, there, wanted)

    async def _set_parameters(
        self, reader: MasterReader, there: Mapping[str, Value], wanted: Mapping[str, Value]
    ) -> int:
        calls: list[MasterCall] = [
            ("setParam", MASTER_NAME, (f"/{name}", value))
            for name, value in wanted.items()
            if name not in _OWN_PARAMETERS and not same_value(there.get(name), value)
        ]
        calls += [
            ("deleteParam", MASTER_NAME, (f"/{name}",))
            for name in there
            if name not in {*wanted, *_OWN_PARAMETERS, *self.left.parameters}
        ]
        await reader.ask_all(calls)
        return len(calls)

    async def _last_word(self, graph: MasterGraph, nodes: list[HeldNode]) -> LastWord:
        """Send each subscriber its list in this graph.

        Before, it gets the list of the appliance, which removes dead connections, then both lists in one, and keeps its
        connections until the new ones stand. Subscribers of `CLOCK` get theirs when the earlier connections have ended.
        A node that does not connect gets its list again: roscpp gives a publisher up after one failed call. A host that
        does not answer delays only its own nodes, and the whole by less than 9 seconds.
        """
        lists = lists_of(graph)
        subscriptions = [
            (node, topic)
            for node, entries in nodes
            for kind, topic, _name in sorted(entries)
            if kind == SUBSCRIPTION
        ]
        last = LastWord({(node, topic): lists.get(topic, []) for node, topic in subscriptions})
        rows = [row for row in subscriptions if row[1] != CLOCK]
        present = {
            (node, topic): [*self.graph.publishers_for(node, topic)] if self.forwards else []
            for node, topic in rows
        }
        both = {row: [*dict.fromkeys((*last.lists[row], *present[row]))] for row in rows}
        await send_lists(self.call, _BESIDES_SECONDS, self._share, present, both)
        await until_connected(self.call, last.wanted_uris(rows))
        final = {row: last.lists[row] for row in rows}
        last.failed = await send_lists(self.call, _LISTS_SECONDS, self._share, final)
        await self._remind(last, rows)
        return last

    async def _remind(self, last: LastWord, rows: Iterable[Subscription]) -> None:
        """Send the last lists of these again to nodes that do not connect."""
        until = clock.now() + LAST_WORD_SECONDS
        for _ in range(_REMINDERS):
            missing = await until_connected(self.call, last.wanted_uris(rows))
            if not missing or clock.now() >= until:
                return
            await send_lists(
                self.call, _BESIDES_SECONDS, self._share, {row: last.lists[row] for row in missing}
            )


async def _whole(change: Awaitable[T]) -> T:
    """Make a change to its end, even if the caller is cancelled."""
    made = asyncio.ensure_future(change)
    try:
        return await asyncio.shield(made)
    except asyncio.CancelledError:
        await asyncio.wait([made])
        raise


def _unregistration(entry: Entry, there: MasterGraph) -> MasterCall:
    kind, resource, name = entry
    detail = there.services.get(resource, "") if kind == SERVICE else there.nodes.get(name, "")
    return _UNREGISTER[kind], name, (resource, detail)


def _places_of(nodes: Iterable[Incarnation]) -> Places:
    return Places({node.name: _place_of(node) for node in nodes})


def _place_of(node: Incarnation) -> NodePlace:
    return NodePlace(node.api_text, node.api, node.host)


def _graph_of(nodes: list[HeldNode]) -> MasterGraph:
    held = {entry: node.api_text for node, entries in nodes for entry in entries}
    return MasterGraph(frozenset(held), nodes={entry[2]: uri for entry, uri in held.items()})


def _is_new(entry: Entry, node: Incarnation, there: MasterGraph) -> bool:
    kind, resource, name = entry
    if entry not in there.entries or there.nodes.get(name) != node.api_text:
        return True
    return kind == SERVICE and _port(there.services.get(resource, "")) != _port(service_text(node, resource))


def _port(uri: str) -> str:
    return uri.rstrip("/").rpartition(":")[2]
