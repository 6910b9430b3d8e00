"""Who calls RVMaster or a node's outer face, the URI that a node gives for itself, and what is answered."""

from dataclasses import dataclass
from typing import NamedTuple

from appliance.master.graph.registry import Incarnation
from appliance.rpc.server import Peer
from appliance.telemetry.audit_trail import Asker
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

Answer = list[Value]
"""What a call returns: `[code, message, value]`; code 1 done, 0 failed or denied, -1 the caller's error."""


@dataclass(frozen=True, slots=True)
class ApiUri:
    """A node's or service's URI as it was given and as it was parsed."""

    text: str
    uri: NodeUri


class Caller(NamedTuple):
    """Who makes a call: the peer, and the `caller_id` he claims.

    `own` marks the appliance's own nodes, which reach RVMaster on a listener of their own. `target` is set on an
    outer face: the incarnation that the call is for.
    """

    peer: Peer
    caller_id: str
    arrived: int
    own: bool = False
    target: Incarnation | None = None

    def as_named(self, caller_id: str) -> "Caller":
        """The same, by the name that it claims in this call."""
        return Caller(self.peer, caller_id, self.arrived, self.own, self.target)

    @property
    def asker(self) -> Asker:
        """The caller as the audit log has him."""
        return Asker(
            self.peer.text, self.caller_id, self.arrived, None if self.target is None else self.target.name
        )
