"""Define the effects of a change of the graph as data.

`graph`, `registry`, `grants` and `revocation` return effects. `enactor` carries them out, in order and in the same turn
of the event loop, so that no reader sees a change without its effects.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from appliance.audit.log.record import Severity
from appliance.master.graph.registry import Durable, Incarnation, NodeRegistration
from appliance.policy.model import Rule
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value

_CALL_BYTES = 200  # an empty call in Python's memory
_TEXT_BYTES = 60  # an empty text in Python's memory


@dataclass(frozen=True, slots=True)
class NodeCall:
    """A call to a node: the method, and the parameters after the caller's name.

    `size` is the approximate size of the call in bytes, if known. Otherwise, `weight` measures the call.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        if self.size:
            return self.size
        texts = [
            text for given in self.parameters for text in (given if isinstance(given, list) else [given])
        ]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(text) for text in texts if isinstance(text, str))


@dataclass(frozen=True, slots=True)
class TellNode:
    """Queue a call to a node, after the calls that already wait for this node."""

    node: Incarnation
    call: NodeCall


@dataclass(frozen=True, slots=True)
class DropCalls:
    """Drop all waiting calls to a node."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class CloseNode:
    """Close a node's endpoints, and add its traffic to the past traffic."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class SaveGrant:
    """Store a grant, because its node never asks again."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class EraseGrant:
    """Remove a grant from the store."""

    row: PermissionRow


@dataclass(frozen=True, slots=True)
class RegisterAtMaster:
    """Make a registration of a node at the ROS master, after all earlier changes there."""

    node: Incarnation
    registration: NodeRegistration


@dataclass(frozen=True, slots=True)
class UnregisterAtMaster:
    """End a registration of a node at the ROS master, after all earlier changes there."""

    node: Incarnation
    registration: NodeRegistration


@dataclass(frozen=True, slots=True)
class UsePorts:
    """Use the port range of a new policy for new nodes. The policy may also name hosts differently."""

    ports: range


@dataclass(frozen=True, slots=True)
class WriteRecord:
    """Write an audit record, with the arguments of `AuditTrail.happened`."""

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
    | CloseNode
    | SaveGrant
    | EraseGrant
    | RegisterAtMaster
    | UnregisterAtMaster
    | UsePorts
    | WriteRecord
)
Effects = list[Effect]
