"""What follows from a change of the graph, as data: `graph`, `registry`, `grants` and `revocation` return it.

They do nothing themselves; `enactor` carries effects out, in their order and in the same turn of the loop, so that
nobody sees a change without what follows from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from appliance.audit.record import Severity
from appliance.master.graph.registry import Durable, Incarnation, Kind, Registration
from appliance.policy.model import Rule
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value

_CALL_BYTES = 200  # a call with nothing in it, and a text with nothing in it, as Python keeps them
_TEXT_BYTES = 60


@dataclass(frozen=True, slots=True)
class NodeCall:
    """One call to a node: method and parameters after the caller's name.

    `size` is about how many bytes it takes, where that is known; a list of publishers is measured here.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        """About how many bytes it takes while it waits."""
        if self.size:
            return self.size
        texts = [
            text for given in self.parameters for text in (given if isinstance(given, list) else [given])
        ]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(text) for text in texts if isinstance(text, str))


@dataclass(frozen=True, slots=True)
class TellNode:
    """Call a node, after what waits for it already."""

    node: Incarnation
    call: NodeCall


@dataclass(frozen=True, slots=True)
class DropCalls:
    """Nothing that waits for a node is told it any more."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class Place:
    """The relay of a publication or service carries it."""

    node: Incarnation
    kind: Kind
    resource: str
    detail: str


@dataclass(frozen=True, slots=True)
class Withdraw:
    """The relay of a publication or service carries it no longer."""

    node: Incarnation
    kind: Kind
    resource: str


@dataclass(frozen=True, slots=True)
class PlaceNode:
    """The relays carry all that a node has, with its grants."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class WithdrawNode:
    """The relays carry nothing of a node."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class CloseNode:
    """Nothing stands for a node any more: its face and ports are closed, and its traffic is counted with the past."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class SaveGrant:
    """Keep a grant: who has it never asks again."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class EraseGrant:
    """A grant is kept no longer."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class PlaceGrant:
    """The relay lets a subscriber or client in."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class RevokeGrant:
    """The relay lets a subscriber or client in no more, and cuts its connection."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class PutBack:
    """ROSMaster hears, in its turn, of registrations that a node has again."""

    node: Incarnation
    registrations: tuple[Registration, ...]


@dataclass(frozen=True, slots=True)
class TakeBack:
    """ROSMaster hears, in its turn, of a registration that a node may not have any more."""

    node: Incarnation
    registration: Registration


@dataclass(frozen=True, slots=True)
class UsePorts:
    """New nodes get ports of this range; hosts may be named otherwise, too."""

    ports: range


@dataclass(frozen=True, slots=True)
class Record:
    """The audit log hears of it; the fields are those of `AuditTrail.happened`."""

    event: str
    reason: str
    host: str
    caller_id: str
    category: str
    resource: str
    severity: Severity = Severity.INFO
    decision: str | None = None
    rule: Rule | None = None
    more: Mapping[str, str] = field(default_factory=dict)


Effect = (
    Durable
    | TellNode
    | DropCalls
    | Place
    | Withdraw
    | PlaceNode
    | WithdrawNode
    | CloseNode
    | SaveGrant
    | EraseGrant
    | PlaceGrant
    | RevokeGrant
    | PutBack
    | TakeBack
    | UsePorts
    | Record
)
Effects = list[Effect]
