"""Define everything that a feature can add to the core.

1. The core knows only these classes and `table.py`. No feature imports another one.
2. Each process loads the table, so a row imports only settings and roles. Everything else is imported when it is
   called, or named by strings.
3. No feature imports `configuration.settings` except in the entry of a process, because the settings import the
   table.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from appliance.cli.verb_table import Verbs
from appliance.configuration.sections import FeatureSection, Sections
from appliance.quotas.table import QuotaRow
from appliance.supervisor.role import Role, SharedMemory

if TYPE_CHECKING:
    from appliance.audit.log.log import AuditLog
    from appliance.channel.admin import AdminRequest
    from appliance.channel.answers.graph_answers import Graph
    from appliance.channel.answers.limit_answers import LimitUse
    from appliance.channel.answers.status import ProcessInfo, Status
    from appliance.channel.link import Link
    from appliance.channel.messages import (
        ApprovalAnswered,
        ApprovalWanted,
        OwnServiceAnswered,
        OwnServiceCalled,
    )
    from appliance.control.assembly.policies import Policies
    from appliance.control.operators.handled_alarms import HandledAlarms
    from appliance.control.operators.request_method import RequestMethod
    from appliance.control.operators.sessions import Sessions
    from appliance.hosts.tunnel_hosts import TunnelHosts
    from appliance.policy.model import Address, Request
    from appliance.policy.policy import Approval
    from appliance.specifications.specification_manager import SpecificationManager
    from appliance.store.ends import EndTable
    from appliance.store.state_file import StateStore
    from appliance.supervisor.service_gate import Pairing
    from appliance.telemetry.audit_trail import AuditTrail, RecordDetails


class KeptHosts(Protocol):
    """Hosts of a feature that the policy names."""

    def addresses(self) -> "Mapping[str, Address]":
        """Return the hosts' addresses by their names in the policy, such as `door:alice`."""


class ConnectedNodes(Protocol):
    """See `NodeConnections` in `appliance/control/operators/node_connections.py`."""

    def is_here(self, host: str) -> bool | None:
        """Return whether a host is the appliance's machine, or null if the appliance cannot know."""

    async def unknown_publishers(self, node: str, topic: str) -> list[str] | None:
        """Return the URIs of a node's publishers that the appliance did not give it, or null without an answer."""


@dataclass(frozen=True)
class FeatureContext:
    """Objects of control that parts of features use. `robot` may be empty."""

    sections: Sections
    trail: "AuditTrail"
    audit: "AuditLog"
    robot: str
    charged_to: Callable[[str], str]
    """Returns the name that is charged for a host's acts."""
    in_force: Callable[[], tuple[int, int]]
    """Returns the revisions of policy and specifications."""


@dataclass(frozen=True)
class OperatorContext:
    """Objects of control that exist later, for operators' work."""

    core: FeatureContext
    appliance: str
    """The name of one of two appliances; empty on a single one."""
    store: "StateStore"
    ends: "EndTable"
    policies: "Policies"
    monitors: "SpecificationManager"
    hosts: "TunnelHosts"
    processes: "Callable[[], Sequence[ProcessInfo]]"
    received: Callable[[int], None]
    """Notes that another machine has all records up to a sequence."""
    graph: "Callable[[], Graph]"
    tokens_changed: Callable[[], None]
    status: "Callable[[], Status]"
    handled_alarms: "HandledAlarms"
    connections: "ConnectedNodes"
    kept: Mapping[str, KeptHosts]


@dataclass(frozen=True)
class FeaturePart:
    """A feature's part of control."""

    links: "Mapping[str, tuple[Link, Any]]" = field(default_factory=dict)
    """Control's ends of the links to the feature's roles, with the messages that each accepts."""
    methods: "tuple[RequestMethod[Any], ...]" = ()
    longest: Mapping[str, int] = field(default_factory=dict)
    """The most bytes of a message on the links to a role."""
    status_fields: Callable[[], Mapping[str, Any]] = dict
    """Returns the states of the feature by their fields in `rosrv status --json`. A state that is missing is null
    there.
    """
    limits: "Callable[[], tuple[LimitUse, ...]]" = lambda: ()
    details: "RecordDetails | None" = None
    """Returns more details of denials and of records above info."""
    called: "Mapping[str, Callable[[OwnServiceCalled], Awaitable[OwnServiceAnswered]]]" = field(
        default_factory=dict
    )
    """Answers nodes' calls of the services whose names end with `/` and the key."""
    holders: "Callable[[], Mapping[str, Address]]" = dict
    """See `Policy.holders`."""
    approved: "Callable[[], frozenset[Approval]]" = frozenset
    """See `Policy.approved`."""
    policy_changed: Callable[[], None] = lambda: None
    """Ends everything that the new policy does not allow, even if the next policy allows it again. A policy also
    changes with its hosts: a door that is removed and added again has the same name and address.
    """
    hold_call: "Callable[[Request], str] | None" = None
    """Holds a call that needs an approval, and returns the text for the denied caller."""
    approve: "Callable[[ApprovalWanted], Awaitable[ApprovalAnswered]] | None" = None
    """Decides about one request to a service that needs approvals."""
    before_end: "Callable[[], Awaitable[None]] | None" = None
    """Finishes what must be done before an ordered end of the appliance."""
    work: Mapping[str, Callable[[], Awaitable[None]]] = field(default_factory=dict)
    """Runs until control ends. The names go into error messages."""
    connected: "Callable[[str, str, str, int], tuple[int, str]] | None" = None
    """`connected(door, ticket, peer, descriptor)` passes on a WebSocket of the api, and returns an HTTP status and
    the reason of a refusal.
    """
    sessions: "Sessions | None" = None
    hosts: "TunnelHosts | None" = None


class ConsolePart(NamedTuple):
    """A component of the console, in a file of the feature's folder `console`.

    A `view` is a page with this title. A `banner` is shown on every view, a `record` beside an audit record, a
    `situation` is a line on top of Now, and `standby` is the page of an appliance that is not active. The parts of a
    place are sorted by `order`, then by the table of features.
    """

    place: Literal["view", "banner", "situation", "now", "record", "robot", "standby"]
    file: str
    component: str
    title: str = ""
    order: int = 0


@dataclass(frozen=True)
class Feature:
    """Everything that a feature adds.

    Hooks of control are named by `module:name`, so that a hook's module may import modules that import the table.
    """

    name: str
    settings: type[FeatureSection] | None = None
    roles: tuple[Role, ...] = ()
    operations: "Callable[[], tuple[type[AdminRequest[Any]], ...]]" = lambda: ()
    """Returns the requests of operators' tools, from which the admin socket, REST and the client are derived."""
    answers: str | None = None
    """`module:name` of the `Answer`s of REST operations that control alone cannot answer."""
    routes: str | None = None
    """`module:function` that returns more REST routes."""
    without_token: tuple[str, ...] = ()
    """Routes that need no token."""
    page: Callable[[Sections], Mapping[str, str]] = lambda _sections: {}
    verbs: Verbs = field(default_factory=dict)
    quotas: tuple[QuotaRow, ...] = ()
    recorded: str | None = None
    """`module:function` that gives `rosrv monitor replay` the messages of a period."""
    console: tuple[ConsolePart, ...] = ()
    memory: Callable[[Sections, int], SharedMemory | None] = lambda _sections, _relays: None
    """Makes the memory that the supervisor shares with this number of relays."""
    make: Callable[[FeatureContext], FeaturePart] | None = None
    operate: Callable[[OperatorContext], FeaturePart] | None = None
    pairing: "Callable[[Path], Pairing | None] | None" = None
    """Returns what the start of one of two appliances needs, or raises `StartError`. The path is the state directory.
    """
    machine: str | None = None
    """Hook: `machine(state)` returns the feature's `MachineWork` in the supervisor."""
    state_files: tuple[str, ...] = ()
    """Files in the state directory that may exist before the first start."""
    may_start: str | None = None
    """Hook: a `StartGate`."""
    keep: str | None = None
    """Hook: `keep(sections, store, lifeline)` returns `KeptHosts` before the policy comes into force."""
    inherit: str | None = None
    """Hook: `inherit(foundation, parts)` returns a `FeaturePart` before control serves."""
