"""The state of the running appliance: its processes, isolation, policy, graph, tunnels, audit log.

Features add fields (`features.view.StateView`).
"""

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, RevisionNote, RevisionNumber, Who, doc
from appliance.channel.answers.host_answers import PortsSeen
from appliance.channel.answers.token_answers import TokenEnding
from appliance.features.views import with_states


class ProcessInfo(msgspec.Struct, frozen=True):
    """One process of the appliance; `since` is RFC 3339 UTC, `pid` 0 while it waits to be started again."""

    role: Annotated[str, doc("which process of the appliance it is")]
    pid: Annotated[int, doc("process id")]
    since: Annotated[str, doc("RFC 3339, UTC, milliseconds")]
    restarts: Annotated[int, doc("number of restarts")]
    sandbox: Annotated[
        str,
        doc(
            "limits of its system calls, files and ports, or empty for the supervisor, or if not reported yet"
        ),
    ] = ""
    lacks: Annotated[list[str], doc("parts of the sandbox that this kernel does not support")] = []
    congestion: Annotated[str, doc("the TCP congestion control of a relay's connections")] = ""
    failing: Annotated[str, doc("why it ends soon after every start, or empty if it is not failing")] = ""
    output: Annotated[list[str], doc("the last lines that the program of a failing process printed")] = []


class FirewallRule(msgspec.Struct, frozen=True):
    """A rule with the packets that it has matched; `in_force` is false if the kernel no longer has it."""

    chain: Annotated[str, doc("chain of the firewall that contains the rule")]
    purpose: Annotated[str, doc("purpose of the rule")]
    rule: Annotated[str, doc("the rule as the firewall shows it")]
    packets: Annotated[int, doc("packets that the rule matched")]
    octets: Annotated[int, doc("bytes that the rule matched")]
    in_force: Annotated[bool, doc("false: the kernel no longer has it")]


class FirewallState(msgspec.Struct, frozen=True, omit_defaults=True):
    """The firewall; fields that this isolation does not use are left out.

    `translations` are chains of other programs on the host; `obstacles` have a remedy each.
    """

    backend: Annotated[str | None, doc("nft or iptables")] = None
    not_used: Annotated[list[str] | None, doc("other back ends, and why they are not used")] = None
    rules: Annotated[list[FirewallRule] | None, doc("rules, with what each has matched")] = None
    forwarding: Annotated[
        list[FirewallRule] | None, doc("on the host, towards the appliance's namespace")
    ] = None
    translations: Annotated[list[str] | None, doc("chains of other programs that translate addresses")] = None
    obstacles: Annotated[list[str] | None, doc("what keeps connections from their end, with a remedy")] = None
    hold_lapsed: Annotated[
        str | None,
        doc(
            "why the robot's own programs may have started without the appliance (`hold: own`), or others were not held"
        ),
    ] = None
    removed: Annotated[
        str | None, doc("what another program removed of these rules in the last hour, and for how long")
    ] = None


class PolicyState(msgspec.Struct, frozen=True):
    """The policy in force; it rolls back at `confirm_by` (seconds since the epoch) unless confirmed."""

    revision: RevisionNumber
    file: Annotated[str, doc("the file that `reload` reads")]
    source: Annotated[str, doc("source of the text in force")]
    who: Who
    differs_from_file: Annotated[bool, doc("whether the policy in force differs from its file")]
    warnings: Annotated[int, doc("number of warnings about the policy")]
    audit_only: Annotated[list[str], doc("sections whose denials are recorded and pass")]
    confirm_by: Moment | None
    loaded: Annotated[
        Moment | None, doc("when it came into force, or null if a version that did not store it made it")
    ] = None
    file_refused: Annotated[
        str, doc("why the file was rejected at the last start or reload, or empty if it was not")
    ] = ""


class IpsecState(msgspec.Struct, frozen=True):
    """The state of the tunnels, and problems that need attention."""

    esp: Annotated[
        Literal["kernel", "user space"] | None, doc("where ESP runs, or null if no tunnels are open")
    ]
    key_exchange: Annotated[
        list[str], doc("key exchanges offered and accepted, best first, or empty if not known yet")
    ]
    post_quantum: Annotated[bool | None, doc("whether ML-KEM is among them, or null if not known yet")]
    charon: Annotated[str | None, doc("its version")]
    pool: Annotated[str, doc("network of the virtual addresses")]
    address: Annotated[str, doc("the appliance's own address in the tunnels")]
    hosts_file: Annotated[str, doc("path of hosts.yaml")]
    enrolled: Annotated[int, doc("number of hosts with a certificate")]
    awaited: Annotated[int, doc("number of hosts whose one-time token was not used yet")]
    up: Annotated[int, doc("number of tunnels that are up")]
    troubles: Annotated[list[str], doc("problems that need a person's attention")]
    ports: Annotated[
        dict[str, PortsSeen], doc("port checks of every host that may have nodes, by name or address")
    ]
    trouble_names: Annotated[
        list[str], doc("the name of each of `troubles`, which follows `ipsec:` in its alarm")
    ] = []


class MonitorsState(msgspec.Struct, frozen=True):
    """The specifications in force, and the names of the monitors that need attention."""

    revision: RevisionNumber
    tag: Annotated[str, doc("changes with every change; If-Match takes it in quotes")]
    loaded: Annotated[int, doc("number of monitors")]
    enabled: Annotated[int, doc("number of enabled monitors")]
    held: Annotated[list[str], doc("monitors that hold their topics until they are resumed")]
    failing: Annotated[
        list[str], doc("monitors whose actions fault; such messages are dropped or pass (`on_fault`)")
    ]
    refused: Annotated[
        list[str], doc("why the relay rejects the specifications: all topics are blocked then")
    ]
    who: Who
    differs_from_folder: Annotated[bool, doc("whether the specifications in force differ from their folder")]
    confirm_by: Moment | None
    shadow: Annotated[list[str], doc("monitors in shadow mode")] = []
    why_held: Annotated[
        dict[str, str], doc("monitors that hold their topics because their state was lost, with the reason")
    ] = {}
    left_out: Annotated[
        dict[str, str],
        doc("files that have an error since the start, so that nothing of them runs, with the error"),
    ] = {}
    folder_refused: Annotated[
        str,
        doc(
            "why the folder was rejected at the last start, or empty if it was not, or another revision came"
        ),
    ] = ""
    unbuilt: Annotated[
        dict[str, str], doc("loaded monitors that do nothing, because their file has an error, with the file")
    ] = {}
    unconfirmed: Annotated[
        dict[str, float], doc("monitors that return to shadow mode unless confirmed, with the time")
    ] = {}


class ClockState(msgspec.Struct, frozen=True):
    """Whether the times of records are reliable."""

    synchronised: Annotated[
        bool | None,
        doc(
            "whether a time service synchronises the machine's clock, or null if the kernel does not report it"
        ),
    ]
    behind_seconds: Annotated[
        float, doc("how far the clock is behind the last record, because it was set back, or 0 if it is not")
    ]
    before_program_seconds: Annotated[
        float,
        doc(
            "how far the clock is before this program's build date, because it was never set, or 0 if it is not"
        ),
    ] = 0.0


class AuditState(msgspec.Struct, frozen=True):
    """How far the audit log is behind, why it cannot be written, and how requests are then answered."""

    lag_records: Annotated[int, doc("number of records that are not on disk yet")]
    lag_seconds: Annotated[float, doc("how long the oldest such record has waited")]
    failed: Annotated[str | None, doc("why the log cannot be written, or null if it can")]
    on_failure: Annotated[
        Literal["deny", "allow"], doc("decision on requests while the log cannot be written")
    ]
    degraded: Annotated[
        str | None,
        doc(
            "which work (checkpoints, index, retention) is behind, or that the disk is nearly full; null if neither"
        ),
    ]
    replaced: Annotated[
        str | None, doc("which other logs the signer signed and no operator set aside, in words, or null")
    ]


if not TYPE_CHECKING:
    AuditState = with_states(AuditState, "audit")


class SwitchedOff(msgspec.Struct, frozen=True):
    """A monitor that an order disabled or put into shadow mode, or a section of the policy that is audit-only."""

    about: Annotated[Literal["monitors", "policy"], doc("what the switch belongs to")]
    name: Annotated[str, doc("name of the monitor or section")]
    what: Annotated[str, doc("a sentence: what is off, and how")]
    again: Annotated[str, doc("how to enable it again")]
    since: Moment
    until: Annotated[Moment | None, doc("when it is enabled again automatically, or null if never")]
    forgotten: Annotated[bool, doc("off for longer than `forgotten_after`: an alarm")]


class BlocksState(msgspec.Struct, frozen=True):
    """The hosts that operators block (`rosrv host blocks`)."""

    hosts: Annotated[int, doc("enrolled, awaited or declared")]
    first_end: Annotated[
        Moment | None, doc("when the first block ends, or null if none ends without an order")
    ]


class MinuteState(msgspec.Struct, frozen=True):
    """The last minute's denials and drops. From `attention_at` denials on, an operator should check them."""

    denials: Annotated[
        int, doc("denials, also of unknown and blocked hosts; `would deny` and `ask` are not counted")
    ]
    drops: Annotated[dict[str, int], doc("messages that monitors dropped, by monitor")]
    attention_at: Annotated[int, doc("the least number of denials that needs attention")] = 10
    most_denied: Annotated[str, doc("the host that was denied most, what, and how often; or empty")] = ""


class HandledAlarm(msgspec.Struct, frozen=True):
    """An alarm that an operator has acknowledged, or silenced for a time."""

    kind: Annotated[str, doc("the alarm's name")]
    who: Annotated[str, doc("name of the token, or `operator`")]
    since: Moment
    until: Annotated[
        Moment | None, doc("when the silence ends, or null if it is acknowledged and not silenced")
    ]
    note: RevisionNote = ""


class NewState(msgspec.Struct, frozen=True):
    """A state directory that is younger than a day; the configuration may be older."""

    since: Moment
    lacks: Annotated[list[str], doc("what an earlier state directory had and this one has not, by name")]


class Status(msgspec.Struct, frozen=True):
    """The running appliance, as `rosrv status --json` shows it; `since` is seconds since the epoch."""

    version: Annotated[str, doc("version of the program")]
    since: Moment
    master: Annotated[str, doc("URI for the nodes' ROS_MASTER_URI")]
    processes: Annotated[list[ProcessInfo], doc("of the appliance, the supervisor first")]
    isolation: Annotated[str, doc("netns, container or none")]
    relaying: Annotated[str, doc("`all`, or `monitored`: only those that a monitor or the policy names")]
    mediation: Annotated[str, doc("`full`, or `monitored`: nodes then get each other's own addresses")]
    firewall: FirewallState
    probe: Annotated[str, doc("probe of the ROS master: `passed`, or the finding, or empty if not run yet")]
    policy: PolicyState
    ipsec: IpsecState
    monitors: MonitorsState
    rosmaster: Annotated[str, doc("reachable, or being rebuilt")]
    relay: Annotated[str, doc("connected, or the number of its processes that are not")]
    nodes: Annotated[int, doc("number of the robot's nodes")]
    shadows: Annotated[int, doc("nodes that do not answer and are expected back")]
    topics: Annotated[int, doc("number of the robot's topics")]
    services: Annotated[int, doc("number of the robot's services")]
    connections: Annotated[int, doc("open connections through the appliance")]
    messages: Annotated[int, doc("messages relayed since RVMaster started")]
    dropped: Annotated[int, doc("messages dropped for slow subscribers")]
    audit: AuditState
    clock: ClockState
    switched_off: Annotated[list[SwitchedOff], doc("what an operator switched off")] = []
    blocks: BlocksState = BlocksState(0, None)
    last_minute: MinuteState = MinuteState(0, {})
    name: Annotated[str, doc("the robot's name (`name` in appliance.yaml), or empty if it has none")] = ""
    handled_alarms: Annotated[
        list[HandledAlarm], doc("alarms that an operator acknowledged or silenced")
    ] = []
    starting: Annotated[bool, doc("RVMaster started less than ten seconds ago")] = False
    new_state: Annotated[
        NewState | None, doc("the state directory, if it is younger than a day, otherwise null")
    ] = None
    tokens_ending: Annotated[list[TokenEnding], doc("access tokens that end within a week")] = []
    now: Annotated[
        Moment | None, doc("the appliance's clock at this answer: the age of `since` is their difference")
    ] = None


if not TYPE_CHECKING:
    Status = with_states(Status, "status")
