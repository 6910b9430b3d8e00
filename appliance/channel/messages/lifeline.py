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

    Control's `detail` has `master` (the URI nodes are told), `revision` (of the policy), `rosout_master` (the URI
    of the loopback listener for the appliance's own nodes), `inner_port` (of the inner faces) and `token` (the
    first access token of REST, if it was made at this start).
    """

    detail: dict[str, Any] = msgspec.field(default_factory=dict)


class Failed(Message):
    """A child cannot serve and says why; the supervisor shows it and stops the appliance, or starts the child again.

    `output` are the last lines of a program that it ran.
    """

    reason: str
    output: list[str] = msgspec.field(default_factory=list)


class Walled(Message):
    """A child's first word: the walls it is in (docs/architecture.md), and what this kernel lacks of them.

    `calls` is how its calls of the kernel are limited: "listed" (only those on a list), "usual" (all but those that no
    process of ours makes) or empty. `landlock` is the ABI of the kernel's Landlock that limits its files and ports;
    0 for none.
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
    """Control gives the supervisor a listening socket to keep over control's death (name is unique)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketDropped(Message):
    """Control no longer needs a kept socket."""

    name: str


class SocketRestored(Message):
    """Supervisor gives a restarted control one kept socket back, or the api the one it serves (`api`)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketsRestored(Message):
    """All kept sockets have been given back; sent at every start of control, also when there are none.

    `announced`: whoever started the appliance has been told what an earlier control said with `Ready`.
    """

    count: int
    announced: bool = False


class Announced(Message):
    """Whoever started the appliance has been told what control said with `Ready`, the first token included."""


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
    """The ROSMaster port could be reached by another user: control stops serving nodes and says why."""

    reason: str


class ProbePassed(Message):
    """The ROSMaster port is hidden (again)."""


class PolicyReloadRequested(Message):
    """Supervisor got SIGHUP: control reads the policy file again, as `rosrv policy reload` would."""


class RouteWanted(Message):
    """Control asks which address of the machine a host uses to reach the appliance (netns isolation)."""

    host: str


class RouteFound(Message):
    """Supervisor's answer to `RouteWanted`; `address` is None where the peer's own route is the right one."""

    host: str
    address: str | None


class EndpointWanted(Message):
    """Control asks at which address hosts of other networks reach the appliance, for their kits."""


class EndpointFound(Message):
    """Supervisor's answer to `EndpointWanted`: the address and why it is that; None: `reason` says why none."""

    address: str | None
    reason: str


class LogHeld(Message):
    """Control cannot write the audit log, because these processes hold its locks."""

    processes: list[int]


class CompilerWanted(Message):
    """Control has specifications to be read: the compiler is started if it is not there; it ends by itself."""


class ApplianceStopRequested(Message):
    """Control asks the supervisor to end the appliance (the `shutdown` call of the Master API, granted)."""

    reason: str


class StateGiven(Message):
    """Supervisor gives a relay a memory for the state of its monitors: its `own`, or one of an earlier life of the
    appliance, to be read only; those come first.

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
