"""The lifeline: supervisor <-> any child."""

from typing import Any, ClassVar

import msgspec

from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.messages.message import Message
from appliance.channel.messages.recorder_link import RingGiven
from appliance.channel.messages.signer_link import SignatureMade, SignatureWanted
from appliance.channel.messages.tunnels import TunnelsEnclosed, TunnelsWanted


class Ping(Message):
    """Supervisor asks a child whether it is alive; unanswered for 5 s, the child is killed and restarted."""

    number: int


class Pong(Message):
    """A child's answer to `Ping`, sent from its main loop."""

    number: int


class Stop(Message):
    """Supervisor asks a child to end cleanly; it has 3 s."""


class Ready(Message):
    """A child is in service. For control: nodes may connect. `detail` is for status (addresses, ports).

    Control's `detail` has `master` (the URI for nodes), `revision` (of the policy), `rosout_master` (the URI of the
    loopback listener for the appliance's own nodes), `inner_port` (of the master-side endpoints) and `token` (the
    first access token of REST, if it was made at this start).
    """

    detail: dict[str, Any] = msgspec.field(default_factory=dict)


class Failed(Message):
    """A child cannot serve, with the reason; the supervisor shows it, and stops the appliance or restarts the child.

    `output` is the last lines of a program that it ran.
    """

    reason: str
    output: list[str] = msgspec.field(default_factory=list)


class Walled(Message):
    """The first message of a child: the sandbox it is in (docs/dev/architecture.md), and what this kernel lacks for
    it.

    `calls` is how its system calls are limited: "listed" (only those on a list), "usual" (all but those that no
    process of the appliance makes) or empty. `landlock` is the ABI of the kernel's Landlock that limits its files and
    ports; 0 for none.
    """

    calls: str
    landlock: int
    lacks: list[str]


class LinkOpened(Message):
    """Supervisor hands a child its end of a new link to another process (replaces an earlier one)."""

    descriptors: ClassVar[int] = 1
    role: str
    index: int


class SocketKept(Message):
    """Control gives the supervisor a listening socket, under a unique name, to keep when control dies."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketDropped(Message):
    """Control no longer needs a kept socket."""

    name: str


class SocketRestored(Message):
    """Supervisor returns a kept socket to a restarted control, or gives the api the one it serves (`api`)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketsRestored(Message):
    """All kept sockets have been returned; sent at every start of control, even if there are none.

    `announced`: the caller that started the appliance has received the `Ready` of an earlier control.
    """

    count: int
    announced: bool = False


class Announced(Message):
    """The caller that started the appliance has received control's `Ready`, with the first token."""


class ProcessesChanged(Message):
    """Supervisor tells control which processes run; sent at start and after every start or death."""

    processes: list[ProcessInfo]


class ClockRead(Message):
    """Supervisor tells control whether a time service keeps the machine's clock: at start, and when it changes."""

    synchronised: bool | None


class FirewallReported(Message):
    """Supervisor tells control the state of isolation and firewall for `rosrv status`."""

    isolation: str
    report: FirewallState


class ProbeFailed(Message):
    """Another user could reach the port of the ROS master: control stops serving nodes and reports why."""

    reason: str


class ProbePassed(Message):
    """The port of the ROS master is hidden (again)."""


class PolicyReloadRequested(Message):
    """Supervisor got SIGHUP: control reads the policy file again, as `rosrv policy reload` would."""


class RouteWanted(Message):
    """Control asks which address of the machine a host uses to reach the appliance (netns isolation)."""

    host: str


class RouteFound(Message):
    """Supervisor's answer to `RouteWanted`; `address` is None if the peer's own route is the right one."""

    host: str
    address: str | None


class EndpointWanted(Message):
    """Control asks for the address at which hosts of other networks reach the appliance, for their kits."""


class EndpointFound(Message):
    """Supervisor's answer to `EndpointWanted`: the address (None: there is none), and the reason."""

    address: str | None
    reason: str


class LogHeld(Message):
    """Control cannot write the audit log, because these processes hold its locks."""

    processes: list[int]


class CompilerWanted(Message):
    """Control has specifications to compile: the supervisor starts the compiler if it is not running."""


class ApplianceStopRequested(Message):
    """Control asks the supervisor to end the appliance (the `shutdown` call of the Master API, granted)."""

    reason: str


class StateGiven(Message):
    """Supervisor gives a relay a memory for the state of its monitors: first those of earlier lives of the appliance,
    which it only reads, then its `own`.

    `boot` names this start of the machine; `offset` and the machine's monotonic clock are the time of monitors (ns).
    `ended_boot` names the start of the machine in which the appliance last ended in order, at `ended_at` (ns since the
    epoch).
    """

    descriptors: ClassVar[int] = 1
    own: bool
    boot: str
    offset: int
    ended_boot: str = ""
    ended_at: int = 0


Lifeline = (
    Ping | Pong | Stop | Walled | Ready | Failed | LinkOpened | SocketKept | SocketDropped | SocketRestored
    | SocketsRestored | Announced | ProcessesChanged | ClockRead | FirewallReported | ProbeFailed | ProbePassed
    | PolicyReloadRequested | RouteWanted | EndpointWanted | EndpointFound
    | TunnelsWanted | TunnelsEnclosed
    | RingGiven | StateGiven | RouteFound | LogHeld | CompilerWanted | ApplianceStopRequested
    | SignatureWanted | SignatureMade
)  # fmt: skip
