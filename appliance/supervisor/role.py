"""Define a row of the table of processes (`roles.py`), with the facts that rows need."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from appliance.configuration.sections import DEFAULTS, FeatureSection, Sections
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.messages import MemoryGiven
    from appliance.supervisor.sandbox.private_view import PrivateView

S = TypeVar("S", bound=FeatureSection)


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
    """One row of the table of processes."""

    name: str
    user: str
    part: str  # its folder in the state directory
    entry: str | None = None
    program: Callable[[Facts], ExternalProgram] | None = None
    path: Callable[[Facts], Path] | None = None
    indexed: bool = False
    most: int | None = None  # processes that may run; None: one for each relay
    links: tuple[str, ...] = ()
    network: bool = True
    asks: bool = False  # the supervisor checks it over HTTP, because the program has no lifeline
    after: str | None = None  # starts when this role is ready
    outlives_control: bool = False  # stopped last
    outlives_takeover: bool = False
    stands_by: bool = False  # also runs while this appliance is passive
    files: int = 1024
    readable_by: str | None = None  # the group of this user may read files of `part`
    listens: bool = False  # the supervisor keeps the listening sockets
    dispensable: bool = False  # the other roles continue when this role cannot serve
    on_demand: bool = False  # control requests the start; exit status 0 causes no restart
    capabilities: tuple[str, ...] = ()
    group: str | None = None  # the `readable_by` of the files that it reads
    secret: Callable[[Facts], Path | None] | None = None
    """A file that the role's user may not read: the last argument of `entry` is its descriptor or None."""
    inputs: Callable[[Facts], tuple[Path, ...]] = (
        lambda _facts: ()
    )  # files of the operator; the supervisor opens them
    ended_early: int = 0  # `oom_score_adj`
    nice: int = 0
    nice_if_busy: bool = False  # `nice` holds only while tasks wait for a processor
    slice_ns: int = 0  # length of its turns without the right to `nice`; 0: the kernel's
    sandbox: Callable[[Facts], SandboxPlan] = lambda _facts: SandboxPlan(allowlist=True)
    paired: bool = False
    configured: Callable[[Sections], bool] = lambda _sections: True
    receiver: Callable[[Sections], RemoteReceiver | None] = lambda _sections: None
    """The only other machine that the user can reach."""
    memory: str = ""
    """`module:function`: it makes the relays' shared memory from the sections and the number of relays, or None."""

    @property
    def serves_robot(self) -> bool:
        return not (self.outlives_takeover or self.stands_by)


def sender(
    name: str,
    user: str,
    part: str,
    entry: str,
    *,
    section: type[S],
    receiver: Callable[[S], RemoteReceiver | None],
    configured: Callable[[S], bool] | None = None,
    reads_log: bool = False,
    **more: Any,
) -> Role:
    """Return the role of a process that speaks with the receiver of its feature's section, and with no other machine.

    Without `configured`, it runs if there is a receiver.
    """

    def receiver_in(sections: Sections) -> RemoteReceiver | None:
        return receiver(sections.of(section))

    def runs(sections: Sections) -> bool:
        return receiver_in(sections) is not None if configured is None else configured(sections.of(section))

    def sandbox(facts: Facts) -> SandboxPlan:
        found, log = receiver_in(facts.sections), (str(facts.part("control")),) if reads_log else ()
        return SandboxPlan(
            allowlist=True,
            families=ROUTES,
            reads=(*log, *folders_of(*facts.sections.of(section).files)),
            connects=None if found is None or found.protocol == "udp" else (found.port,),
        )

    return Role(
        name, user, part, entry, path=lambda facts: facts.config, links=("control",), nice=10, after="control",
        dispensable=True, group="rosrv-api" if reads_log else None,
        inputs=lambda facts: facts.sections.of(section).files, sandbox=sandbox, configured=runs, receiver=receiver_in,
        **more,
    )  # fmt: skip
