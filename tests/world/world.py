"""One history of a whole world in virtual time, made from a seed, and the promises that it must keep.

1. No call and no message passes undecided: the audit log has the allowed decision of each grant at the relay, and of
   each acknowledged registration. With `durability: strict`, it has the record before the grant.
2. After the answer to a reload, the relay has no grant that the policy denies, and carries nothing that it denies.
3. Nodes learn only the addresses of proxy endpoints and of the relay.
4. No acknowledged change is lost: after a restart of control, or of the whole appliance, the last acknowledged policy
   is in force, and nodes read the acknowledged values of parameters.
5. The chain of the audit log verifies at the end, over all lives of control.
6. A restart of control interrupts no connection that the policy allows.
7. Once faults have ended, `rosmaster` has exactly the registrations of the registry, and live subscribers are
   connected to exactly the live publishers that the policy allows.
"""

import asyncio
import contextlib
import logging
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator, MutableMapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Literal, NoReturn

import structlog

from appliance.audit.proof.verification import verify
from appliance.channel import admin, messages
from appliance.control.control import Control
from appliance.master.graph.registry import Kind, Life
from roswire.parameter_tree import standing_at
from tests.world import seams
from tests.world.appliance import MASTER_PORT, ROSMASTER_PORT, Appliance, Connection
from tests.world.loop import BrokenPromiseError, Machine, Process, WorldLoop
from tests.world.network import Network
from tests.world.ros import Node, Subscription
from tests.world.streams import Streams

HOSTS = ("10.0.0.1", "10.0.0.2", "10.0.0.3")
APPLIANCE = "10.0.0.100"
NAMES = ("/one", "/two", "/three")
TOPICS = ("/a", "/b")
SERVICES = ("/s",)
KEYS = ("/p", "/q/r")
POLICY = (
    "[Nodes]\ndefault=*\n[Publishers]\n{}default=*\n[Subscribers]\n{}default=*\n[Services]\ndefault=*\n"
    "[Parameters]\nread default=*\nwrite default=*\n[Commands]\ndefault=*\n"
)


class Policy:
    """A policy and, as the oracle, the hosts that it lets publish, subscribe and call. Other resources are open."""

    def __init__(self, publish: dict[str, str] | None = None, use: dict[str, str] | None = None) -> None:
        self.publish = {one: set(hosts.split()) for one, hosts in (publish or {}).items()}
        self.use = {one: set(hosts.split()) for one, hosts in (use or {}).items()}
        rules = (
            "".join(f"{one} = {', '.join(sorted(hosts))}\n" for one, hosts in table.items() if one in TOPICS)
            for table in (self.publish, self.use)
        )
        self.text = POLICY.format(*rules)

    def may_publish(self, topic: str, host: str) -> bool:
        return host in self.publish.get(topic, HOSTS)

    def may_use(self, resource: str, host: str) -> bool:
        return host in self.use.get(resource, HOSTS)


@dataclass
class Setting:
    under_way: int = 0
    values: set[int | None] = field(default_factory=set)
    known: bool = False


@dataclass(eq=False)
class Read:
    """A read under way, with the values that it may get."""

    key: str
    values: set[int | None]


POLICIES = {
    "open": Policy(),
    "/a is published by 1": Policy({"/a": HOSTS[0]}),
    "/a is subscribed to by 2 and 3": Policy(use={"/a": f"{HOSTS[1]} {HOSTS[2]}"}),
    "/b is nobody's": Policy({"/b": ""}, {"/b": ""}),
}
_AGAIN_SECONDS = 0.5
_ORDER_SECONDS = (0.0, 0.001, 0.01)


class World:
    pauses: tuple[float, ...] = (0.0, 0.001, 0.05, 0.5, 3.0, 30.0)
    settles = 150.0

    def __init__(self, seed: int, folder: Path, say: Callable[[str], object]) -> None:
        self.random = Random(seed)  # noqa: S311  histories, no secrets
        self.loop = WorldLoop(self.random)
        self.loop.set_exception_handler(self._fault)
        self.network = Network(self.loop)
        self.streams = Streams(self.network)
        self._say = say
        self.errors: list[Exception] = []
        self.processes: list[Process] = []
        self._numbers = 100
        self._ports = 40_000
        self.machines = {name: self._machine(name) for name in (*HOSTS, APPLIANCE)}
        self.master_uri = f"http://{APPLIANCE}:{MASTER_PORT}/"
        self.nodes: list[Node] = []
        self.possible = {"open"}  # policies that may be in force
        self.ordering = 0  # orders under way
        self.unread: str | None = None  # the policy in the file, if no order since has been acknowledged
        self.parameters: dict[str, set[int | None]] = {key: {None} for key in KEYS}
        self._setting = {key: Setting() for key in KEYS}
        self._reads: list[Read] = []
        self.strict = self.random.random() < 0.5
        self.appliances = self._make_appliances(folder)
        self.appliance = self.appliances[0]
        for appliance in self.appliances:
            appliance.policy.write_text(POLICIES["open"].text, encoding="utf-8")

    def _make_appliances(self, folder: Path) -> list[Appliance]:
        return [Appliance(self, self.machines[APPLIANCE], folder / "appliance", self.durability)]

    @property
    def durability(self) -> Literal["strict", "batched"]:
        return "strict" if self.strict else "batched"

    def start(self) -> None:
        self.appliance.start()

    def activated(self, appliance: Appliance, epoch: int) -> None: ...

    # --- services for the models ---

    def _machine(self, name: str) -> Machine:
        return Machine(name, self.loop, self.random.uniform(0, 1000), 1 + self.random.uniform(-0.01, 0.01))

    def process(self, name: str, machine: Machine) -> Process:
        process = Process(name, machine)
        process.ends.append(lambda: self.network.broken(process))
        self.processes.append(process)
        return process

    def number(self) -> int:
        self._numbers += 1
        return self._numbers

    def say(self, line: str) -> None:
        self._say(f"{self.loop.present:9.3f}  {line}")

    def fail(self, text: str) -> None:
        self.say(f"BROKEN: {text}")
        self.errors.append(BrokenPromiseError(text))

    def logged(self, _logger: object, level: str, event: MutableMapping[str, Any]) -> NoReturn:
        text = ", ".join(f"{key}={value!r}" for key, value in event.items())
        if level == "critical":
            self.fail(f"fault: {text}")
        elif level in ("error", "warning"):
            self.say(f"    log: {text}")
        raise structlog.DropEvent

    def _fault(self, _loop: object, context: dict[str, Any]) -> None:
        self.fail(f"unhandled: {context.get('message')}: {context.get('exception')!r}")

    def done(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and task.exception() is not None:
            self.fail(f"control ended: {task.exception()!r}")

    # --- what nodes do and see ---

    def ends(self, node: Node) -> None:
        if node.alive:
            self.say(f"{node} ends")
            node.process.kill()
            relay = self.appliance.relay
            for connection in [one for one in relay.connections if self._is_of(one, node)]:
                relay.disconnect(connection, "closed")

    @staticmethod
    def _is_of(connection: Connection, node: Node) -> bool:
        return (connection.host, connection.caller_id) == (node.host, node.name)

    def takes_name(self, node: Node) -> None:
        for other in self.nodes:
            if other.name == node.name and other is not node:
                other.superseded = True

    def acknowledged(self, node: Node, method: str, resource: str) -> None:
        self.decided(method, resource, node.host, node.name)

    def granted(self, grant: messages.GrantInstalled | messages.ClientGranted) -> None:
        if isinstance(grant, messages.GrantInstalled):
            self.decided("requestTopic", grant.topic, grant.host, grant.caller_id)
        else:
            self.decided("lookupService", grant.service, grant.host, grant.caller_id)

    def decided(self, call: str, resource: str, host: str, name: str) -> None:
        """Check that the log has the decision that allowed a call. Without `strict`, a crash may lose it."""
        if self.strict and not self._recorded(
            "event = 'decision' AND decision = 'allow' AND host = ? AND resource = ? AND caller_id = ?",
            host, resource, name,
        ):  # fmt: skip
            self.fail(f"{call} {resource} by {name} of {host} passed without a decision in the log")

    def _recorded(self, condition: str, *values: str) -> bool:
        query = f"SELECT count(*) FROM record WHERE {condition}"  # noqa: S608  fixed texts
        for path in self._logs():
            with contextlib.closing(sqlite3.connect(path)) as connection:
                if connection.execute(query, values).fetchone()[0]:
                    return True
        return False

    def _logs(self) -> list[Path]:
        paths = [appliance.state / "control" / "audit.db" for appliance in self.appliances]
        return [path for path in paths if path.exists()]

    def sees(self, node: Node, uris: list[str]) -> None:
        """Check that a node gets only ports of the appliance, as others would bypass it."""
        for uri in uris:
            if f"//{APPLIANCE}:" not in uri and uri != node.api:
                self.fail(f"{node} was told {uri}, which bypasses the relay")

    def connect(self, node: Node, topic: str, port: int) -> None:
        connection = self.appliance.relay.connect(port, "topic", topic, node.host, node.name)
        if connection is not None:
            self.carries(connection)

    def disconnect(self, node: Node, topic: str, port: int) -> None:
        relay = self.appliance.relay
        key = relay.keys.get(port, "")
        relay.disconnect(Connection(key, "topic", topic, node.host, node.name), "closed")

    def call_service(self, node: Node, service: str, port: int) -> None:
        relay = self.appliance.relay
        connection = relay.connect(port, "service", service, node.host, node.name)
        if connection is not None:
            self.carries(connection)
            relay.disconnect(connection, "closed")

    def parameter_set(self, key: str, *, known: bool) -> None:
        setting = self._setting[key]
        setting.under_way -= 1
        setting.known |= known
        if setting.known and not setting.under_way:
            self.parameters[key] = setting.values

    @contextlib.contextmanager
    def reading(self, key: str) -> Iterator[set[int | None]]:
        read = Read(key, set(self.parameters[key]))
        self._reads.append(read)
        try:
            yield read.values
        finally:
            self._reads.remove(read)

    # --- promises ---

    def carries(self, connection: Connection) -> None:
        if not any(POLICIES[one].may_use(connection.resource, connection.host) for one in self.possible):
            self.fail(f"{connection} carries messages, which no policy allows")

    def check(self) -> None:
        relay = self.appliance.relay
        if not relay.process.alive:
            return
        for connection in relay.connections:
            self.carries(connection)
        for grant in relay.grants():
            if not any(POLICIES[one].may_use(grant.topic, grant.host) for one in self.possible):
                self.fail(f"the relay has {grant}, which no policy allows")

    def interrupted(self, connection: Connection) -> None:
        parts = self.appliance.parts
        publisher = parts and parts.registry.by_key(connection.key)
        if not publisher or publisher.life is not Life.LIVE or connection.kind != "topic":
            return
        host, topic = str(publisher.host), connection.resource
        subscribed = any(
            node.alive
            and not node.superseded
            and self._is_of(connection, node)
            and topic in node.subscribes
            and ("registerSubscriber", topic) not in node.calling
            for node in self.nodes
        )
        allowed = all(
            POLICIES[one].may_publish(topic, host) and POLICIES[one].may_use(topic, connection.host)
            for one in self.possible
        )
        if subscribed and allowed and (Kind.PUBLICATION, topic) in publisher.registrations:
            self.fail(f"a restart of control interrupts {connection}")

    def control_ready(self, _appliance: Appliance) -> None:
        self.loop.outside.start(self._learn())

    async def _learn(self) -> None:
        possible = self.possible
        answer = await self.order(admin.PolicyWanted())
        if (
            answer is None or self.ordering or self.possible != possible
        ):  # the answer may be older than a reload
            return
        found = {name for name, policy in POLICIES.items() if policy.text == answer.text}
        if not found & self.possible:
            self.fail(f"the policy {found} is in force, acknowledged was {self.possible}")
        self.possible = found
        self.check()

    # --- operators ---

    async def order(self, request: admin.AdminRequest[Any]) -> Any:
        given = getattr(self.appliance.admin, "administration", None)
        if given is None:
            return None
        administration, process = given
        if not process.alive:
            return None
        future: asyncio.Future[Any] = self.loop.create_future()

        async def carry_out() -> None:
            answer = await administration.carry_out(request, who="operator")
            self.loop.outside.call(self.random.choice(_ORDER_SECONDS), answered, answer)

        def answered(answer: Any) -> None:
            if not future.done():
                future.set_result(answer)

        process.ends.append(lambda: self.loop.outside.call(1.0, answered, None))
        process.start(carry_out())
        answer = await future
        if answer is not None and answer.trouble in ("standby", "failed"):  # an appliance without the lease
            return None
        if answer is not None and not answer.ok:
            self.fail(f"{request} is rejected: {answer.error}")
        return None if answer is None else answer.body

    async def reload(self) -> None:
        name = self.random.choice(list(POLICIES))
        self.say(f"policy: {name}")
        self.possible = self.possible | {name}
        self.ordering += 1
        if self.random.random() < 0.5:
            self.appliance.policy.write_text(POLICIES[name].text, encoding="utf-8")
            self.unread = name
            answer = await self.order(admin.PolicyReload())
        else:
            answer = await self.order(admin.PolicyLoad(POLICIES[name].text))
        self.ordering -= 1
        if answer is not None:
            self.say(f"policy: {name} is in force, {answer.revoked} revoked")
            self.possible, self.unread = {name}, None
            self.check()
        else:
            await self.find_out()

    async def find_out(self) -> None:
        while len(self.possible) > 1:
            await asyncio.sleep(_AGAIN_SECONDS)
            await self._learn()

    # --- events ---

    def _living(self) -> Node | None:
        there = [node for node in self.nodes if node.alive]
        return self.random.choice(there) if there else None

    def starts(self) -> None:
        host = self.random.choice(HOSTS)
        self._ports += 1
        name = self.random.choice(NAMES)
        node = Node(self, self.process(name, self.machines[host]), name, self._ports)
        self.nodes.append(node)
        node.process.start(node.connect())
        for topic in TOPICS:
            if self.random.random() < 0.5:
                self.publishes(node, topic)
            if self.random.random() < 0.5:
                self.subscribes(node, topic)
        for service in SERVICES:
            if self.random.random() < 0.3:
                node.services.add(service)
                node.register("registerService", service)

    def publishes(self, node: Node, topic: str) -> None:
        node.publishes.add(topic)
        node.register("registerPublisher", topic)

    def subscribes(self, node: Node, topic: str) -> None:
        node.subscribes.setdefault(topic, Subscription())
        node.register("registerSubscriber", topic)

    def changes_its_mind(self) -> None:
        node, topic = self._living(), self.random.choice(TOPICS)
        if node is None or any(one[1] == topic for one in node.calling):
            return
        if self.random.random() < 0.5:
            if topic in node.publishes:
                node.publishes.discard(topic)
                node.register("unregisterPublisher", topic)
            else:
                self.publishes(node, topic)
        elif topic in node.subscribes:
            for port in node.subscribes.pop(topic).ports.values():
                self.disconnect(node, topic, port)
            node.register("unregisterSubscriber", topic)
        else:
            self.subscribes(node, topic)

    def uses_service(self) -> None:
        node = self._living()
        if node is not None:
            node.process.start(node.use_service(self.random.choice(SERVICES)))

    def sets_parameter(self) -> None:
        node, key, value = self._living(), self.random.choice(KEYS), self.number()
        if node is not None:
            if not self._setting[key].under_way:
                self._setting[key] = Setting()
            setting = self._setting[key]
            setting.under_way += 1
            setting.values.add(value)
            self.parameters[key] = self.parameters[key] | {value}
            for read in self._reads:
                if read.key == key:
                    read.values.add(value)
            node.process.start(node.set_parameter(key, value))

    def reads_parameter(self) -> None:
        node = self._living()
        if node is not None:
            node.process.start(node.get_parameter(self.random.choice(KEYS)))

    def dies(self) -> None:
        node = self._living()
        if node is not None:
            self.ends(node)

    def hangs(self) -> None:
        node = self._living()
        if node is not None:
            node.answers = not node.answers
            self.say(f"{node} {'answers' if node.answers else 'hangs'}")

    def is_cut_off(self) -> None:
        pair = frozenset((self.random.choice(HOSTS), APPLIANCE))
        self.network.cut ^= {pair}
        self.say(f"{sorted(pair)} {'are cut off' if pair in self.network.cut else 'reach each other'}")

    def reloads(self) -> None:
        if not self.ordering:
            self.loop.outside.start(self.reload())

    def rosmaster_dies(self) -> None:
        self.say("rosmaster starts again")
        self.appliance.restart_rosmaster()

    def rosmaster_breaks_off(self) -> None:
        self.say("calls to rosmaster break off")
        self.network.flaky = ("127.0.0.1", ROSMASTER_PORT)

    def relay_dies(self) -> None:
        self.say("the relay starts again")
        self.appliance.restart_relay()

    def control_dies(self) -> None:
        steps = self.random.choice((1, 10, 100, 1000))
        control = self.appliance.control
        if control is not None:
            control.doom = self.random.randint(1, steps), self._kill_control

    def _kill_control(self) -> None:
        self.say("control is killed")
        self.appliance.kill_control()

    def crashes(self) -> None:
        self.say("the appliance crashes")
        if self.unread is not None:  # a start reads the file
            self.possible = self.possible | {self.unread}
        self.appliance.crash()

    # --- the history ---

    async def run(self) -> None:
        self.start()
        usual = (
            self.starts, self.starts, self.changes_its_mind, self.uses_service, self.sets_parameter,
            self.reads_parameter, self.reloads, self.reloads,
        )  # fmt: skip
        # Few kinds of faults in a history, but often: so they meet one another more often than if all were mixed.
        faults = self.random.sample(self.faults(), self.random.randint(1, 4))
        for _ in range(self.random.randrange(6, 24)):
            self.random.choice(self.random.choice((usual, faults)))()
            await self.passes(self.random.choice(self.pauses))
        self.say("no faults any more")
        self.network.cut.clear()
        self.network.flaky = None
        for process in self.processes:
            process.doom = None
        for node in self.nodes:
            node.answers = True
        await self.passes(self.settles)
        await self.settled()
        self.quiet()

    def faults(self) -> list[Callable[[], None]]:
        return [
            self.dies, self.hangs, self.is_cut_off, self.rosmaster_dies, self.rosmaster_breaks_off,
            self.relay_dies, self.control_dies, self.crashes,
        ]  # fmt: skip

    async def settled(self) -> None: ...

    async def passes(self, seconds: float) -> None:
        await asyncio.sleep(seconds)
        if self.errors:
            raise self.errors[0]

    def quiet(self) -> None:
        parts = self.appliance.parts
        if not self.appliance.ready or parts is None:
            raise BrokenPromiseError("control is not ready")
        self._check_master(parts)
        self._check_connected(parts)
        self._check_parameters(parts)

    def _check_master(self, parts: Control) -> None:
        words = {Kind.PUBLICATION: "Publisher", Kind.SUBSCRIPTION: "Subscriber", Kind.SERVICE: "Service"}
        faces, rosmaster = parts.faces, self.appliance.rosmaster
        wanted = {
            (words[one.kind], one.resource, node.name, faces.inner_uri(node))
            for node, one in parts.registry.in_order()
            if one.kind in words
        }
        there = {
            (kind, resource, name, uri)
            for kind, table in rosmaster.tables.items()
            for resource, holders in table.items()
            for name, uri in holders.items()
        }
        if there != wanted:
            raise BrokenPromiseError(f"rosmaster has {there - wanted} and lacks {wanted - there}")

    def _check_connected(self, parts: Control) -> None:
        holders = {
            incarnation.key: node
            for incarnation in parts.registry.live()
            for node in self.nodes
            if node.alive and (node.name, node.api) == (incarnation.name, incarnation.api_text)
        }
        ports = {node.relay_port: node.key for node in parts.registry.all()}
        for node in holders.values():
            if not node.superseded:  # else another node has its name
                for topic, subscription in node.subscribes.items():
                    self._check_heard(node, topic, subscription, holders, ports)

    def _check_heard(
        self,
        node: Node,
        topic: str,
        subscription: Subscription,
        holders: dict[str, Node],
        ports: dict[int, str],
    ) -> None:
        [policy], relay = self.possible, self.appliance.relay
        wanted = {
            key
            for key, holder in holders.items()
            if holder is not node and topic in holder.publishes
            if POLICIES[policy].may_publish(topic, holder.host) and POLICIES[policy].may_use(topic, node.host)
        }
        whose = ("topic", topic, node.host, node.name)
        heard = {key for key, *rest in relay.connections if tuple(rest) == whose}
        told = {ports.get(subscription.ports.get(uri, 0), uri) for uri in subscription.known}
        open_to_doubt = {key for key, holder in holders.items() if holder.superseded}
        wanted, heard, told = (keys - open_to_doubt for keys in (wanted, heard, told))
        if heard != wanted or told != wanted:
            raise BrokenPromiseError(f"{node} hears {heard} on {topic}, knows {told}, and may have {wanted}")

    def _check_parameters(self, parts: Control) -> None:
        rosmaster = self.appliance.rosmaster
        for key, values in self.parameters.items():
            value, _above = standing_at(parts.parameters.tree, key)
            there, _above = standing_at(rosmaster.parameters, key)
            if value not in values or there != value:
                raise BrokenPromiseError(
                    f"{key} is {value!r} ({there!r} at rosmaster), which is not one of {values}"
                )

    def check_chain(self) -> None:
        for path in self._logs():
            found = verify(path)
            if found.findings:
                raise BrokenPromiseError(f"the audit log does not verify: {found.findings}")


def _dropped(_logger: object, _level: str, _event: MutableMapping[str, Any]) -> NoReturn:
    raise structlog.DropEvent


def run(
    seed: int, say: Callable[[str], object] = lambda _line: None, kind: "type[World] | None" = None
) -> None:
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="world-", dir=shared if shared.is_dir() else None))
    before = structlog.get_config()
    world = (kind or World)(seed, folder, say)
    structlog.configure(
        processors=[world.logged], wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG)
    )
    asyncio.set_event_loop(world.loop)
    try:
        with seams.joined(world.network, world.streams, world.random):
            world.loop.run_until_complete(world.loop.outside.start(world.run()))
            for process in world.processes:
                process.kill()
        world.check_chain()
        if world.errors:
            raise world.errors[0]
    finally:
        structlog.configure(processors=[_dropped])
        world.loop.discard()
        structlog.configure(**before)
        asyncio.set_event_loop(None)
        shutil.rmtree(folder)
