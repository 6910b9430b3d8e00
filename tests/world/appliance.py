"""A simulated appliance: the product's control process, and models of its supervisor and of its relay.

The relay decides with the product's own grant table. Its connections are rows, which can carry messages at any time.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from appliance.channel import messages
from appliance.configuration.settings import Audit, LivenessSection, Settings
from appliance.control.control import Control
from appliance.control.process import _run as run_control
from appliance.features.standby.membership import LINK_FILE, Membership, save_membership
from appliance.features.standby.pairing import LeaseWatch
from appliance.features.standby.process import EPOCH, LeaseProcess
from appliance.relay.connections.admission import missing
from appliance.relay.grant_table import GrantTable
from appliance.supervisor.service_gate import RoleChanges, ServiceGate
from tests.world.loop import BrokenPromiseError, Machine, Process
from tests.world.network import LinkEnd
from tests.world.ros import RosMaster
from tests.world.seams import Socket

if TYPE_CHECKING:
    from tests.world.world import World

MASTER_PORT = 11311
ROSMASTER_PORT = 11312
_BOOT_SECONDS = (0.5, 3.0, 20.0)
_RESTART_SECONDS = (0.2, 0.5, 1.5)


class Connection(NamedTuple):
    key: str
    kind: str
    resource: str
    host: str
    caller_id: str

    @property
    def fields(self) -> dict[str, str]:
        return {self.kind: self.resource, "callerid": self.caller_id, "md5sum": "*"}


class Relay:
    def __init__(self, world: "World", process: Process, link: LinkEnd) -> None:
        self.process = process
        self.table = GrantTable()
        self.keys: dict[int, str] = {}  # by port
        self.connections: dict[Connection, int] = {}
        self._granted: dict[tuple[str, str, str, str], None] = {}  # all grants that this relay ever had
        self._world = world
        self._opened = 0
        self.link = link
        self.attach(link)

    def attach(self, link: LinkEnd) -> None:
        self.link = link
        self.process.run(link.attach, None, self._received, lambda: None)

    def _received(self, message: Any, descriptors: tuple[Any, ...]) -> None:
        table = self.table
        match message:
            case messages.OrdersAsked():
                self.link.send(messages.OrdersCarriedOut())
            case messages.SpecificationsStated():
                taken = messages.SpecificationsTaken(message.revision, [], [], message.statement)
                self.link.send(taken)
            case messages.StateBegan(epoch):
                table.begin(epoch)
            case messages.StateEnded(epoch):
                table.end(epoch)
            case messages.NodePlaced():
                self.keys[descriptors[0].address[1]] = message.key
                table.state(message)
            case messages.GrantInstalled() | messages.ClientGranted():
                self._world.granted(message)
                table.state(message)
                if isinstance(message, messages.GrantInstalled):
                    self._granted[message.key, message.topic, message.host, message.caller_id] = None
            case messages.PublicationPlaced() | messages.ServicePlaced():
                table.state(message)
            case messages.FactWithdrawn(fact):
                table.withdraw(fact)
        for connection in [one for one in self.connections if self.refusal(one)]:
            if isinstance(message, messages.StateEnded):
                self._world.interrupted(connection)
            self.disconnect(connection, "revoked")
        self._world.check()

    def refusal(self, connection: Connection) -> str:
        return missing(self.table, connection.key, connection.host, connection.fields)

    def connect(self, port: int, kind: str, resource: str, host: str, caller_id: str) -> Connection | None:
        connection = Connection(self.keys.get(port, ""), kind, resource, host, caller_id)
        if not self.process.alive:
            return None
        if self.process.paused:
            self.process.call(0.0, self.connect, port, kind, resource, host, caller_id)
            return None
        if connection not in self.connections and not self.refusal(connection):
            self._opened += 1
            self.connections[connection] = self._opened
            self.link.send(
                messages.ConnectionOpened(self._opened, connection.key, resource, kind, host, caller_id)
            )
        return connection if connection in self.connections else None

    def disconnect(self, connection: Connection, reason: str) -> None:
        number = self.connections.pop(connection, None)
        if number is not None:
            self.link.send(messages.ConnectionClosed(number, reason))

    def grants(self) -> Iterator[messages.GrantInstalled]:
        for key, topic, host, name in self._granted:
            grant = self.table.grant(key, topic, host, name)
            if grant is not None:
                yield grant


@dataclass(eq=False)
class Appliance:
    world: "World"
    machine: Machine
    state: Path
    durability: Literal["strict", "batched"]
    rosmaster_port: int = ROSMASTER_PORT
    membership: Membership | None = None
    sockets: dict[str, Socket] = field(default_factory=dict)
    control: Process | None = None
    relay: Relay = field(init=False)
    rosmaster: RosMaster = field(init=False)
    ready: bool = False
    lives: int = 0
    supervisor: Process = field(init=False)
    lease: Process | None = None

    def __post_init__(self) -> None:
        self.address = self.machine.name
        self.admin = Socket("admin", 0)
        self.policy = self.state / "policy.ini"
        (self.state / "control").mkdir(parents=True)
        self._lifeline: LinkEnd | None = None
        self._lease_lifeline: LinkEnd | None = None
        self.parts: Control | None = None  # of the present control
        self.settings = Settings(
            policy=self.policy,
            state=self.state,
            listen=f"{self.address}:{MASTER_PORT}",
            rosmaster_port=self.rosmaster_port,
            isolation="none",
            api="off",
            hosts=self.state / "hosts.yaml",
            relays=1,
            audit=Audit(durability=self.durability),
            liveness=LivenessSection(silent=20.0),
        )
        if self.membership is not None:
            save_membership(self.state / LINK_FILE, self.membership)
        self._boot()

    def _boot(self) -> None:
        self.supervisor = self.world.process("supervisor", self.machine)
        self._announced = False
        self._lifeline = self._lease_lifeline = None
        self.control = None
        self.sockets.clear()
        self.start_rosmaster()
        self.start_relay()
        kind = ServiceGate if self.membership is None else LeaseWatch
        self.watch = kind(
            RoleChanges(self._activate, self._passivate, self._suspend, lambda: self._pause(paused=False))
        )

    def start(self) -> None:
        if self.membership is not None:
            self.start_lease()
        self.start_control()

    @property
    def active(self) -> bool:
        return self.supervisor.alive and self.watch.active

    def crash(self) -> None:
        lease = [self.lease] if self.lease is not None else []
        for process in (self.control, self.relay.process, self.rosmaster.process, self.supervisor, *lease):
            if process is not None:
                process.kill()
        self.ready = False
        self.world.loop.outside.call(self.world.random.choice(_BOOT_SECONDS), self._again)

    def _again(self) -> None:
        if not self.supervisor.alive:
            self._boot()
            self.start()

    def start_lease(self) -> None:
        assert self.membership is not None
        self.lease = self.world.process("lease", self.machine)
        mine, its = LinkEnd.pair(self.supervisor, self.lease)
        self._lease_lifeline = mine
        mine.process.run(mine.attach, None, self._heard_lease, lambda: None)
        made = self.lease.run(LeaseProcess.open, self.membership, its, self.state / EPOCH)
        self.lease.start(made.run()).add_done_callback(self.world.done)

    def _heard_lease(self, message: Any, _descriptors: tuple[Any, ...]) -> None:
        self.watch.heard(message)

    def _activate(self, epoch: int) -> None:
        self.world.activated(self, epoch)
        if self._lifeline is not None:
            self._lifeline.send(messages.Activated(epoch))

    def _suspend(self) -> bool:
        if self.ready:
            self._pause(paused=True)
        return self.ready

    def _pause(self, *, paused: bool) -> None:
        self.world.say(f"{self.address} is {'suspended' if paused else 'active again'}")
        for process in (self.control, self.relay.process, self.rosmaster.process):
            if process is not None:
                process.paused = paused

    def _end_lapse(self) -> None:
        self.watch.died("control", serves_robot=True)

    def pause_lease(self, seconds: float) -> None:
        if self.lease is not None:
            self.lease.paused = True
            self.world.loop.outside.call(seconds, setattr, self.lease, "paused", False)

    def _passivate(self) -> None:
        self.world.say(f"{self.address} is passive")
        self.sockets.clear()
        self.restart_rosmaster()
        self.restart_relay()
        self.kill_control()

    def restart_rosmaster(self) -> None:
        self._end_lapse()
        self.rosmaster.process.kill()
        self.start_rosmaster()

    def start_rosmaster(self) -> None:
        self.rosmaster = RosMaster(
            self.world, self.world.process("rosmaster", self.machine), self.rosmaster_port
        )
        if self._lifeline is not None:
            self._lifeline.send(messages.ProcessesChanged([]))

    def restart_relay(self) -> None:
        self._end_lapse()
        self.relay.process.kill()
        self.start_relay()

    def start_relay(self) -> None:
        process = self.world.process("relay", self.machine)
        end, _unused = LinkEnd.pair(process, self.supervisor)
        self.relay = Relay(self.world, process, end)
        if self.control is not None and self.control.alive:
            self._link_relay()

    def start_control(self) -> None:
        self.lives += 1
        self.control = self.world.process("control", self.machine)
        mine, its = LinkEnd.pair(self.supervisor, self.control)
        self._lifeline = mine
        self.ready = False
        mine.process.run(mine.attach, None, self._received, lambda: None)
        if self.membership is not None and self.watch.epoch is not None:
            mine.send(messages.Activated(self.watch.epoch))
        for name, sock in {"admin": self.admin, **self.sockets}.items():
            mine.send(messages.SocketRestored(name), (sock,))
        mine.send(messages.SocketsRestored(len(self.sockets), self._announced))
        config = self.state / "config.json"
        self.control.made = self._made
        task = self.control.start(run_control(self.settings, its, config))  # type: ignore[arg-type]  # a link in memory
        task.add_done_callback(self.world.done)
        self._link_relay()
        if self._lease_lifeline is not None and self.lease is not None:
            leases, controls = LinkEnd.pair(self.lease, self.control)
            self._lease_lifeline.send(messages.LinkOpened("control", 0), (leases,))
            mine.send(messages.LinkOpened("lease", 0), (controls,))

    def _made(self, parts: Control) -> None:
        self.parts = parts

    def _link_relay(self) -> None:
        assert self.control is not None and self._lifeline is not None
        relays, controls = LinkEnd.pair(self.relay.process, self.control)
        self.relay.attach(relays)
        self._lifeline.send(messages.LinkOpened("relay", 0), (controls,))

    def kill_control(self) -> None:
        if self.control is not None and self.control.alive:
            self._end_lapse()
            self.control.kill()
            self.ready = False
            self.supervisor.call(self.world.random.choice(_RESTART_SECONDS), self._start_again)

    def _start_again(self) -> None:
        if self.control is None or not self.control.alive:
            self.start_control()

    def _received(self, message: Any, descriptors: tuple[Any, ...]) -> None:
        match message:
            case messages.SocketKept(name):
                self.sockets[name] = descriptors[0]
            case messages.SocketDropped(name):
                self.sockets.pop(name, None)
            case messages.Ready(detail) if "stands_by" in detail:
                self.world.say(f"control of {self.address} stands by")
            case messages.Ready():
                self.ready = self._announced = True
                self.world.say(f"control of {self.address} is ready")
                self.world.control_ready(self)
            case messages.Failed(reason):
                raise BrokenPromiseError(f"control does not start: {reason}")
