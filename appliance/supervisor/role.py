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
    """One row of the table of processes.

    `most` processes may run (None: one for each relay), after the role `after` is ready; with `stands_by`, even while
    this appliance is passive. `listens`: the supervisor keeps the listening sockets. `on_demand`: control requests
    the start, and exit status 0 is not followed by a restart. `asks`: the supervisor checks a program without a
    lifeline over HTTP. `dispensable`: the other roles continue when this role cannot serve. `outlives_control` roles
    are stopped last.

    The group of the user `readable_by` may read files of `part`; a role that reads them has this user as `group`.
    `secret` is a file that the role's user may not read: the last argument of `entry` is its descriptor or None.
    `inputs` are files of the operator, which the supervisor opens. `ended_early` is the `oom_score_adj`. With
    `nice_if_busy`, a running process has `nice` only while tasks wait for a processor. `slice_ns` is the length of its
    turns if it may not have its niceness (0: the kernel's). `receiver` is the only
    other machine that the user can reach. `memory` names a function (`module:function`) that gets the sections and the
    number of relays, and makes the memory that they share, or returns None.
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
    nice_if_busy: bool = False
    slice_ns: int = 0
    sandbox: Callable[[Facts], SandboxPlan] = lambda _facts: SandboxPlan(allowlist=True)
    paired: bool = False
    configured: Callable[[Sections], bool] = lambda _sections: True
    receiver: Callable[[Sections], RemoteReceiver | None] = lambda _sections: None
    memory: str = ""

    @property
    def serves_robot(self) -> bool:
        return not (self.outlives_takeover or self.stands_by)
