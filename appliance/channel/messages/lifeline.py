"""The lifeline: the link between the supervisor and each child process."""

from typing import Any, ClassVar

import msgspec

from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.messages.message import Message
from appliance.channel.messages.signer_link import SignatureMade, SignatureWanted
from appliance.channel.messages.tunnels import TunnelsEnclosed, TunnelsWanted


class Ping(Message):
    """The supervisor asks a child whether it is alive. Without an answer in 5 s, the child is killed and restarted."""

    number: int


class Pong(Message):
    """A child answers `Ping` from its main loop."""

    number: int


class Stop(Message):
    """The supervisor asks a child to end within 3 s."""


class Ready(Message):
    """A child is in service. If the child is control, nodes may connect. `detail` is for the status: addresses, ports.

    Control's `detail` has these keys:

    - `master`: the URI for nodes
    - `revision`: the revision of the policy
    - `rosout_master`: the URI of the loopback listener for the appliance's own nodes
    - `inner_port`: the port of the master-side endpoints
    - `token`: the first access token of REST, if it was made at this start
    """

    detail: dict[str, Any] = msgspec.field(default_factory=dict)


class Failed(Message):
    """A child cannot serve. The supervisor shows the reason, and stops the appliance or restarts the child.

    `output` has the last lines of output of the program that the child ran.
    """

    reason: str
    output: list[str] = msgspec.field(default_factory=list)


class Walled(Message):
    """The first message of a child describes its sandbox (docs/dev/architecture.md) and missing kernel features.

    `calls` is the limit on its system calls: "listed" (only calls on a list are allowed), "usual" (calls that no
    process of the appliance makes are forbidden) or empty. `landlock` is the ABI version of the kernel's Landlock that
    limits its files and ports; 0 means none.
    """

    calls: str
    landlock: int
    lacks: list[str]


class LinkOpened(Message):
    """The supervisor gives a child its end of a new link to another process. It replaces an earlier link."""

    descriptors: ClassVar[int] = 1
    role: str
    index: int


class SocketKept(Message):
    """Control gives the supervisor a listening socket with a unique name. The supervisor keeps it if control dies."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketDropped(Message):
    """Control no longer needs the kept socket with this name."""

    name: str


class SocketRestored(Message):
    """The supervisor returns a kept socket to a restarted control, or gives the api its listening socket (`api`)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketsRestored(Message):
    """The supervisor has returned all kept sockets. It sends this at every start of control, even if there are none.

    `announced`: the caller that started the appliance has received the `Ready` of an earlier control process.
    """

    count: int
    announced: bool = False


class Announced(Message):
    """The caller that started the appliance has received control's `Ready`, with the first token."""


class ProcessesChanged(Message):
    """The supervisor lists the running processes for control: at the start, and after each start or death of one."""

    processes: list[ProcessInfo]


class ClockRead(Message):
    """The supervisor reports whether a time service synchronises the machine's clock: at the start, and on changes."""

    synchronised: bool | None


class FirewallReported(Message):
    """The supervisor reports the state of isolation and firewall, for `rosrv status`."""

    isolation: str
    report: FirewallState


class ServicePaused(Message):
    """The supervisor tells the api that a lapse of the lease has stopped control; without `reason`, control goes on."""

    reason: str


class ProbeFailed(Message):
    """Another user could reach the port of the ROS master. Control stops serving nodes and reports the reason."""

    reason: str


class ProbePassed(Message):
    """The probe found that the port of the ROS master is hidden."""


class PolicyReloadRequested(Message):
    """The supervisor received SIGHUP. Control reads the policy file again, as for `rosrv policy reload`."""


class RouteWanted(Message):
    """Control asks for the machine's address that a host uses to reach the appliance (isolation by a namespace)."""

    host: str


class RouteFound(Message):
    """The supervisor answers `RouteWanted`. `address` is None if the address that the peer used is correct."""

    host: str
    address: str | None


class EndpointWanted(Message):
    """Control asks for the address at which hosts of other networks reach the appliance, for their kits."""


class EndpointFound(Message):
    """The supervisor answers `EndpointWanted` with the address, or None, and the reason."""

    address: str | None
    reason: str


class LogHeld(Message):
    """Control cannot write the audit log, because these processes hold its locks."""

    processes: list[int]


class CompilerWanted(Message):
    """Control has specifications to compile. The supervisor starts the compiler if it is not running."""


class ProcessWanted(Message):
    """Control asks the supervisor to start a process of a role on demand, if it is not running."""

    role: str
    index: int


class OwnNetworkWanted(Message):
    """Control asks for a network whose addresses only the appliance itself may use, and for open TCP ports.

    Each request replaces the earlier ports. The network cannot change while the appliance runs.
    """

    network: str
    ports: list[int]


class OwnNetworkOpened(Message):
    """The supervisor answers `OwnNetworkWanted`: empty, or the reason of the failure."""

    reason: str = ""


class ApplianceStopRequested(Message):
    """Control asks the supervisor to end the appliance, after a granted `shutdown` call of the Master API."""

    reason: str


class MemoryGiven(Message):
    """The supervisor gives a process shared memory of a feature, and the feature's `terms` for it.

    `used_by` is the feature's function that a relay calls with them (`module:function`); other processes need none.
    """

    descriptors: ClassVar[int] = 1
    terms: dict[str, Any]
    used_by: str = ""


class StateGiven(Message):
    """The supervisor gives a relay shared memory with the state of monitors.

    It sends the memory of earlier lives of the appliance first, which the relay only reads, and then the relay's `own`.
    `boot` identifies the present boot of the machine. The monitors' time (ns) is the machine's monotonic clock plus
    `offset`. `ended_boot` identifies the boot in which the appliance last ended in order, at `ended_at` (ns since the
    epoch).
    """

    descriptors: ClassVar[int] = 1
    own: bool
    boot: str
    offset: int
    ended_boot: str = ""
    ended_at: int = 0


class LeaseHeld(Message):
    """The lease reports that this appliance is active until `until` (seconds of CLOCK_BOOTTIME), in this epoch.

    If no later time follows, the supervisor stops all processes that serve the robot.
    """

    until: float
    epoch: int


class LeaseEnded(Message):
    """The lease reports that this appliance is not active any more.

    `renewable`: no other appliance can have had a grant so far, so a renewal in the same epoch may follow.
    """

    renewable: bool = False


class Activated(Message):
    """The supervisor tells control of one of two appliances that it is active, in this epoch of the lease."""

    epoch: int


Lifeline = (
    Ping | Pong | Stop | Walled | Ready | Failed | LinkOpened | SocketKept | SocketDropped | SocketRestored
    | SocketsRestored | Announced | ProcessesChanged | ClockRead | FirewallReported | ProbeFailed | ProbePassed
    | PolicyReloadRequested | RouteWanted | EndpointWanted | EndpointFound
    | TunnelsWanted | TunnelsEnclosed | ProcessWanted | OwnNetworkWanted | OwnNetworkOpened
    | MemoryGiven | StateGiven | RouteFound | LogHeld | CompilerWanted | ApplianceStopRequested
    | SignatureWanted | SignatureMade
    | LeaseHeld | LeaseEnded | Activated | ServicePaused
)  # fmt: skip
