"""The lifeline: the link between the supervisor and each child."""

from typing import Any, ClassVar

import msgspec

from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.messages.message import Message
from appliance.channel.messages.signer_link import SignatureMade, SignatureWanted
from appliance.channel.messages.tunnels import TunnelsEnclosed, TunnelsWanted


class Ping(Message):
    """A question that a child must answer within 5 s; otherwise it is killed and restarted."""

    number: int


class Pong(Message):
    """The answer to `Ping` from the child's main loop."""

    number: int


class Stop(Message):
    """The child must end within 3 s. `failed`: the whole appliance ends because of a failure, not by order."""

    failed: bool = False


class Ready(Message):
    """A child is in service. `detail` is for the status: addresses, ports.

    Control's `detail` has `master` (the URI for nodes), `revision` (of the policy), `rosout_master` (the URI of the
    loopback listener for the appliance's own nodes), `inner_port` (of the master-side endpoints), and `token`, the
    first access token of REST, if it was made at this start.
    """

    detail: dict[str, Any] = msgspec.field(default_factory=dict)


class Failed(Message):
    """A child cannot serve. `output` has the last lines of the program that it ran."""

    reason: str
    output: list[str] = msgspec.field(default_factory=list)


class Walled(Message):
    """The first message of a child: its sandbox (docs/dev/architecture.md).

    `calls` limits its system calls: "listed" (only those on a list), "usual" (all but those that no process of the
    appliance makes) or empty. `landlock` is the ABI version of the kernel's Landlock; 0: none.
    """

    calls: str
    landlock: int
    lacks: list[str]


class LinkOpened(Message):
    """A child's end of a new link, which replaces an earlier one."""

    descriptors: ClassVar[int] = 1
    role: str
    index: int


class SocketKept(Message):
    """A listening socket, which the supervisor keeps if control dies."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketDropped(Message):
    """Control no longer needs this socket."""

    name: str


class SocketRestored(Message):
    """A kept socket for a restarted control, or for the api (`api`)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketsRestored(Message):
    """All kept sockets are returned; sent at every start of control.

    `announced`: the caller that started the appliance has received an earlier `Ready`.
    """

    count: int
    announced: bool = False


class Announced(Message):
    """The caller that started the appliance has received `Ready`, with the first token."""


class ProcessesChanged(Message):
    """Sent at the start, and after each start or death of a process."""

    processes: list[ProcessInfo]


class ProcessDied(Message):
    """A process ended unexpectedly, by a signal or with an exit status (`end`), after `lived` seconds.

    `reason` has its own words, or why the supervisor killed it. `restarts` counts the starts after the first one.
    Sent once control serves: of the ends before, the last one of each process.
    """

    role: str
    index: int
    pid: int
    end: str
    reason: str
    lived: float
    restarts: int


class ClockRead(Message):
    """Tells whether a time service synchronises the machine's clock; sent at the start, and on changes."""

    synchronised: bool | None


class MachineAddresses(Message):
    """The addresses of the robot's machine; packets with them are its own. Sent at the start, and on changes."""

    addresses: list[str]


class FirewallReported(Message):
    """The state of isolation and firewall, for `rosrv status`."""

    isolation: str
    report: FirewallState


class RulesRestored(Message):
    """Another program had removed rules of the firewall, which are in force again.

    `seconds` is the time from its change, or, if the kernel did not report it, since the last check. `connections`
    began in that time and were ended.
    """

    rules: list[str]
    by: str
    seconds: float
    reported: bool
    connections: int


class ServicePaused(Message):
    """The lease has lapsed and control is stopped, for the api; without `reason`, control continues."""

    reason: str


class ProbeFailed(Message):
    """Another user could reach the port of the ROS master, so control stops serving nodes."""

    reason: str


class ProbePassed(Message):
    """The port of the ROS master is hidden."""


class PolicyReloadRequested(Message):
    """After SIGHUP, control reads the policy file as for `rosrv policy reload`."""


class RouteWanted(Message):
    """Control asks for the machine's address by which a host reaches the appliance."""

    host: str


class RouteFound(Message):
    """The answer to `RouteWanted`; `address` is None if the host used the right one."""

    host: str
    address: str | None


class EndpointWanted(Message):
    """Control asks for the address at which hosts of other networks reach the appliance."""


class EndpointFound(Message):
    """The address, or None and the reason."""

    address: str | None
    reason: str


class LogHeld(Message):
    """These processes hold locks of the audit log, so control cannot write it."""

    processes: list[int]


class CompilerWanted(Message):
    """Start the compiler if it is not running."""


class ProcessWanted(Message):
    """Start a process of a role on demand, if it is not running."""

    role: str
    index: int


class ProcessOverdue(Message):
    """Kill a process of a role on demand, which did not end in time, or closed its link and lives on."""

    role: str
    index: int


class NodeSilent(Message):
    """Restart a program that is a ROS node, such as rosout: control got no answer from its node."""

    role: str


class OwnNetworkWanted(Message):
    """Control asks for a network that only the appliance itself may use, and for open TCP ports.

    Each request replaces the earlier ports. The network cannot change while the appliance runs.
    """

    network: str
    ports: list[int]


class OwnNetworkOpened(Message):
    """Tells whether the own network is open; otherwise, it has the reason of the failure."""

    reason: str = ""


class MachineWorkWanted(Message):
    """Control asks for a piece of a feature's work on the machine, which only the supervisor may do."""

    number: int
    feature: str
    work: str
    terms: dict[str, object]


class MachineWorkDone(Message):
    """The result of the work; with a `reason`, it failed."""

    number: int
    found: dict[str, object]
    reason: str = ""


class EndAnnounced(Message):
    """The appliance ends by order. Features first finish what cannot be done later; then control sends `EndAgreed`."""


class EndAgreed(Message):
    """Control has done what must be done before the appliance ends."""


class ApplianceStopRequested(Message):
    """Sent after a granted `shutdown` call of the Master API."""

    reason: str


class MemoryGiven(Message):
    """Shared memory of a feature, with the feature's `terms` for `used_by` (`module:function`) in a relay."""

    descriptors: ClassVar[int] = 1
    terms: dict[str, object]
    used_by: str = ""


class StateGiven(Message):
    """Shared memory with the state of monitors, for a relay: first that of earlier lives, then its `own`.

    The monitors' time (ns) is the monotonic clock plus `offset`. The appliance last ended in order in `ended_boot`, at
    `ended_at` (ns since the epoch).
    """

    descriptors: ClassVar[int] = 1
    own: bool
    boot: str
    offset: int
    ended_boot: str = ""
    ended_at: int = 0


class HeartbeatGiven(Message):
    """For a relay: the memory in which relays say that they are fit, or (`line`) the serial line of the heartbeat."""

    descriptors: ClassVar[int] = 1
    line: bool = False


class HeartbeatLineWanted(Message):
    """A relay asks for the serial line of the heartbeat, which it lacks."""


class LeaseHeld(Message):
    """This appliance is active until `until` (seconds of CLOCK_BOOTTIME).

    If no later time follows, the supervisor stops all processes that serve the robot.
    """

    until: float
    epoch: int


class LeaseEnded(Message):
    """This appliance is not active any more; `renewable`: a renewal in the same epoch may follow."""

    renewable: bool = False


class Activated(Message):
    """This appliance is active, in this epoch of the lease."""

    epoch: int


Lifeline = (
    Ping | Pong | Stop | Walled | Ready | Failed | LinkOpened | SocketKept | SocketDropped | SocketRestored
    | SocketsRestored | Announced | ProcessesChanged | ProcessDied | ClockRead | MachineAddresses | FirewallReported
    | RulesRestored
    | ProbeFailed | ProbePassed | PolicyReloadRequested | RouteWanted | EndpointWanted | EndpointFound
    | TunnelsWanted | TunnelsEnclosed | ProcessWanted | ProcessOverdue | NodeSilent
    | OwnNetworkWanted | OwnNetworkOpened
    | MachineWorkWanted | MachineWorkDone | EndAnnounced | EndAgreed
    | MemoryGiven | StateGiven | HeartbeatGiven | HeartbeatLineWanted | RouteFound | LogHeld | CompilerWanted
    | ApplianceStopRequested
    | SignatureWanted | SignatureMade
    | LeaseHeld | LeaseEnded | Activated | ServicePaused
)  # fmt: skip
