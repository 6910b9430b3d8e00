"""Define a row of the table of processes (`roles.py`), with the facts that rows need."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from appliance.configuration.sections import DEFAULTS, Sections
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.messages import MemoryGiven
    from appliance.supervisor.sandbox.private_view import PrivateView


@dataclass(frozen=True)
class Facts:
    """The facts that rows need; control reports some of them when it is ready."""

    state: Path
    config: Path
    rosmaster_port: int
    rosout_master: str | None = None
    rosout_ports: range | None = None  # None: the kernel chooses the port
    ca_passphrase_file: Path | None = None
    control_reads: tuple[Path, ...] = ()
    sections: Sections = DEFAULTS  # of features
    view: "PrivateView | None" = None
    raised: int = 0  # by which the supervisor has lowered its own niceness; its children inherit this

    def part(self, name: str) -> Path:
        return self.state / name

    def run(self, name: str) -> Path:
        return self.config.with_name(name)


class RemoteReceiver(NamedTuple):
    """A receiver on another machine; `client` is a name in the firewall's rules."""

    client: str
    protocol: str  # udp, or a protocol over TCP
    address: str
    port: int


class SharedMemory(Protocol):
    """Memory that is made at the start, given to processes, and outlives them."""

    def messages_for(self, role: str, index: int) -> "Iterator[tuple[MemoryGiven, int]]":
        """Yield messages and descriptors for the start of a process."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class ExternalProgram:
    """A program with its environment, without HOME and PATH."""

    argv: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Role:
    """One row of the table.

    Start: `path` returns the last argument of `entry`. `indexed` roles get their number; they have `most`
    processes (None: one for each relay). `after` is the role that must be ready first. `outlives_takeover`:
    the role continues when this appliance becomes passive. `stands_by`: a role with `after` also runs while
    this appliance is passive. `listens`: each process of the role gets the listening socket that the
    supervisor keeps for it. `on_demand`: the role starts when control requests it, and does not restart after
    exit status 0.

    Watching: `asks`: the supervisor checks over HTTP whether the role is alive (for a program without a
    lifeline). `dispensable`: the other roles continue when this role cannot serve. `outlives_control` roles
    are stopped last.

    Permissions: `part` is the role's folder in the state directory. `links` are the roles it talks to.
    `files` is the limit on open files. `readable_by` is the user whose group may enter `part` and read its
    group-readable files. `group` is the user whose group replaces the role's own, so the role can read files
    that are `readable_by` that user. `capabilities` lists the `privileges.SUPERVISOR_CAPABILITIES` that the
    role keeps. `secret` is a file that the role's user may not read; it is opened before the privileges are
    dropped, and the last argument of `entry` is its descriptor or None. `inputs` are files and folders of the
    operator, which the supervisor opens for the role if the role's user may not reach them. `sandbox` has the
    permitted system calls, and the files and ports besides the role's part and the system. `ended_early` is
    the role's `oom_score_adj` (0 to 1000): the kernel kills a higher one earlier if memory is short. `nice`
    is its niceness: a higher one yields the processor, so that no console delays a stop. A negative one has
    effect if the supervisor may give it (CAP_SYS_NICE). `slice_ns` is the length of its turns at the
    processor (0: the kernel's): a process with short turns waits less for each. `receiver` is the only other
    machine that the firewall lets the user reach.

    A feature's role runs if the settings of features let it (`configured`), and a `paired` one only on one of
    two appliances.
    """

    name: str
    user: str
    part: str
    entry: str | None = None
    program: Callable[[Facts], ExternalProgram] | None = None
    path: Callable[[Facts], Path] | None = None
    indexed: bool = False
    most: int | None = None
    links: tuple[str, ...] = ()
    network: bool = True
    asks: bool = False
    after: str | None = None
    outlives_control: bool = False
    outlives_takeover: bool = False
    stands_by: bool = False
    files: int = 1024
    readable_by: str | None = None
    listens: bool = False
    dispensable: bool = False
    on_demand: bool = False
    capabilities: tuple[str, ...] = ()
    group: str | None = None
    secret: Callable[[Facts], Path | None] | None = None
    inputs: Callable[[Facts], tuple[Path, ...]] = lambda _facts: ()
    ended_early: int = 0
    nice: int = 0
    slice_ns: int = 0
    sandbox: Callable[[Facts], SandboxPlan] = lambda _facts: SandboxPlan(allowlist=True)
    paired: bool = False
    configured: Callable[[Sections], bool] = lambda _sections: True
    receiver: Callable[[Sections], RemoteReceiver | None] = lambda _sections: None

    @property
    def serves_robot(self) -> bool:
        """Whether the role may run only while this appliance is active; a pause stops it."""
        return not (self.outlives_takeover or self.stands_by)
