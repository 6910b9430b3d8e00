"""How the running appliance stands: its processes, isolation, policy, graph, tunnels, audit log."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, told
from appliance.channel.answers.host_answers import PortsSeen


class ProcessInfo(msgspec.Struct, frozen=True):
    """One process of the appliance; `since` is RFC 3339 UTC, `pid` 0 while it waits to be started again."""

    role: str
    pid: int
    since: Annotated[str, told("RFC 3339, UTC, milliseconds")]
    restarts: int
    sandbox: Annotated[
        str,
        told("limits of its system calls, files and ports; empty: the supervisor, or not reported yet"),
    ] = ""
    lacks: Annotated[list[str], told("the parts of the sandbox that this kernel lacks")] = []
    congestion: Annotated[str, told("the TCP congestion control of a relay's connections")] = ""
    failing: Annotated[str, told("why it ends soon after every start; empty: it does not")] = ""
    output: Annotated[list[str], told("the last lines that the program of a failing process printed")] = []
    walls: Annotated[str, told("the same as `sandbox`; deprecated")] = ""


class FirewallRule(msgspec.Struct, frozen=True):
    """A rule with what it has matched so far; `in_force` is false when the kernel has it no more."""

    chain: str
    purpose: str
    rule: str
    packets: int
    octets: int
    in_force: bool


class FirewallState(msgspec.Struct, frozen=True, omit_defaults=True):
    """The firewall; what this isolation does not have is left out.

    `translations` and `obstacles` are chains of other programs on the host, which translate or drop what is forwarded.
    """

    backend: str | None = None
    not_used: Annotated[list[str] | None, told("other back ends, and why they are not used")] = None
    rules: list[FirewallRule] | None = None
    forwarding: Annotated[
        list[FirewallRule] | None, told("on the host, towards the appliance's namespace")
    ] = None
    translations: list[str] | None = None
    obstacles: list[str] | None = None


class PolicyState(msgspec.Struct, frozen=True):
    """The policy in force; `confirm_by` (seconds since the epoch) is when it goes back unless confirmed."""

    revision: int
    file: Annotated[str, told("what `reload` reads")]
    source: Annotated[str, told("where the text in force came from")]
    who: str
    differs_from_file: bool
    warnings: int
    audit_only: Annotated[list[str], told("sections whose denials are recorded and pass")]
    confirm_by: Moment | None


class IpsecState(msgspec.Struct, frozen=True):
    """The state of the tunnels, and problems that need attention."""

    esp: Annotated[Literal["kernel", "user space"] | None, told("where ESP runs; null: no tunnels are open")]
    key_exchange: Annotated[list[str], told("offered and accepted, the best first; empty: not known yet")]
    post_quantum: Annotated[bool | None, told("whether ML-KEM is among them; null: not known yet")]
    charon: Annotated[str | None, told("its version")]
    pool: str
    address: Annotated[str, told("the appliance's own in the tunnels")]
    hosts_file: str
    enrolled: int
    awaited: int
    up: int
    troubles: Annotated[list[str], told("what a person should look at")]
    ports: Annotated[dict[str, PortsSeen], told("of every host that may have nodes, by name or address")]


class MonitorsState(msgspec.Struct, frozen=True):
    """The specifications in force, and the names of the monitors that need attention."""

    revision: int
    tag: str
    loaded: int
    enabled: int
    held: list[str]
    failing: list[str]
    refused: Annotated[list[str], told("why the relay does not take them: everything is blocked then")]
    who: str
    differs_from_folder: bool
    confirm_by: Moment | None
    shadow: Annotated[list[str], told("monitors in shadow mode")] = []
    why_held: Annotated[
        dict[str, str], told("why the state of those was lost that hold their topics for that")
    ] = {}


class ForwardingState(msgspec.Struct, frozen=True):
    """How far the audit log is forwarded: `behind` records wait, the oldest for `seconds`; `missed` were removed.

    `sent` messages since the forwarder started, up to the record `sequence` and the checkpoint `checkpoint`.
    """

    sent: int
    sequence: int
    checkpoint: int
    behind: int
    seconds: float
    missed: int
    trouble: Annotated[str, told("why nothing goes on, or empty")]
    to: str
    send: str


class ClockState(msgspec.Struct, frozen=True):
    """Whether the times of records can be believed."""

    synchronised: Annotated[
        bool | None,
        told("whether a time service keeps the machine's clock; null: its kernel does not tell us"),
    ]
    behind_seconds: Annotated[
        float, told("how long the clock stands before the last record: it was set back; 0: it does not")
    ]
    before_program_seconds: Annotated[
        float, told("how long it stands before this program was made: it was never set; 0: it does not")
    ] = 0.0


class AuditState(msgspec.Struct, frozen=True):
    """How far the audit log is behind, why it cannot be written, and what becomes of requests then."""

    lag_records: int
    lag_seconds: float
    failed: str | None
    on_failure: Literal["deny", "allow"]
    degraded: str | None
    forwarding: Annotated[ForwardingState | None, told("null: it is not to be forwarded")]


class RecorderState(msgspec.Struct, frozen=True):
    """The flight recorder: how many recordings are kept, and their bytes."""

    running: bool
    recordings: int
    bytes: int


class SwitchedOff(msgspec.Struct, frozen=True):
    """A monitor that an order disabled or put into shadow mode, or a section of the policy that is audit-only."""

    about: Annotated[Literal["monitors", "policy"], told("what it belongs to")]
    name: Annotated[str, told("of the monitor, or of the section")]
    what: Annotated[str, told("a sentence: what is off, and how")]
    again: Annotated[str, told("what brings it back")]
    since: Moment
    until: Annotated[Moment | None, told("when it comes back by itself; null: never")]
    forgotten: Annotated[bool, told("off for longer than `forgotten_after`: an alarm")]


class Status(msgspec.Struct, frozen=True):
    """The running appliance, as `rosrv status --json` shows it; `since` is seconds since the epoch."""

    version: str
    since: Moment
    master: Annotated[str, told("where nodes find their master")]
    processes: list[ProcessInfo]
    isolation: str
    relaying: Annotated[
        str, told("`all`, or `monitored`: then what no monitor is on passes the appliance by")
    ]
    mediation: Annotated[str, told("`full`, or `monitored`: then nodes are told each other's own addresses")]
    firewall: FirewallState
    probe: Annotated[str, told("of the hidden ROS Master: `passed`, or what was seen; empty: not run yet")]
    policy: PolicyState
    ipsec: IpsecState
    monitors: MonitorsState
    rosmaster: str
    relay: str
    nodes: int
    shadows: int
    topics: int
    services: int
    connections: int
    messages: int
    dropped: int
    audit: AuditState
    clock: ClockState
    recorder: Annotated[RecorderState | None, told("null: nothing is recorded")] = None
    switched_off: Annotated[list[SwitchedOff], told("what an operator switched off")] = []
