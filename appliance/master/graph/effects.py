"""Define the effects of a change of the graph, as data: `graph`, `registry`, `grants` and `revocation` return them.

`enactor` carries the effects out, in order and in the same turn of the event loop, so that no reader sees a change
without its effects.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from appliance.audit.record import Severity
from appliance.master.graph.registry import Durable, Incarnation, Kind, NodeRegistration
from appliance.policy.model import Rule
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value

_CALL_BYTES = 200  # an empty call, and an empty text, in Python's memory
_TEXT_BYTES = 60


@dataclass(frozen=True, slots=True)
class NodeCall:
    """A call to a node: method and parameters after the caller's name.

    `size` is its approximate size in bytes, if known; otherwise `weight` measures the call.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        """Return the approximate size of the waiting call in bytes."""
        if self.size:
            return self.size
        texts = [
            text for given in self.parameters for text in (given if isinstance(given, list) else [given])
        ]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(text) for text in texts if isinstance(text, str))


@dataclass(frozen=True, slots=True)
class TellNode:
    """A call to a node, after the calls that already wait for it."""

    node: Incarnation
    call: NodeCall


@dataclass(frozen=True, slots=True)
class DropCalls:
    """The end of all waiting calls to a node."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class PlaceResource:
    """A publication or service that its relay carries from now on."""

    node: Incarnation
    kind: Kind
    resource: str
    detail: str


@dataclass(frozen=True, slots=True)
class WithdrawResource:
    """A publication or service that its relay no longer carries."""

    node: Incarnation
    kind: Kind
    resource: str


@dataclass(frozen=True, slots=True)
class PlaceNode:
    """A node whose topics, services and grants the relays carry from now on."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class WithdrawNode:
    """A node that the relays no longer carry."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class CloseNode:
    """A node whose endpoints are closed, and whose traffic is added to the past traffic."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class SaveGrant:
    """A grant to store, because its node never asks again."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class EraseGrant:
    """A grant to remove from the store."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class PlaceGrant:
    """A grant by which the relay admits a subscriber or client."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class RevokeGrant:
    """A grant that the relay revokes, and whose connection it cuts."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class PutBack:
    """Restored registrations of a node, to make at the ROS master in their turn."""

    node: Incarnation
    registrations: tuple[NodeRegistration, ...]


@dataclass(frozen=True, slots=True)
class TakeBack:
    """A revoked registration of a node, to end at the ROS master in its turn."""

    node: Incarnation
    registration: NodeRegistration


@dataclass(frozen=True, slots=True)
class UsePorts:
    """The range of ports for new nodes under a new policy, which may name hosts differently."""

    ports: range


@dataclass(frozen=True, slots=True)
class WriteRecord:
    """A record for the audit log, with the fields of `AuditTrail.happened`."""

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
    | PlaceResource
    | WithdrawResource
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
    | WriteRecord
)
Effects = list[Effect]
