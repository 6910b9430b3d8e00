"""The caller of RVMaster or of a proxy endpoint, and the answer to it."""

from dataclasses import dataclass
from typing import NamedTuple

from appliance.master.graph.registry import Incarnation
from appliance.rpc.server import Peer
from appliance.telemetry.audit_trail import Asker
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

Answer = list[Value]
"""The result of a call: `[code, message, value]`; code 1 done, 0 failed or denied, -1 the caller's error."""


@dataclass(frozen=True, slots=True)
class ApiUri:
    """A URI as received, and parsed."""

    text: str
    uri: NodeUri


class Caller(NamedTuple):
    """The peer, and the `caller_id` that the peer claims.

    `own` marks the appliance's own nodes, which have a separate listener. `target` is the incarnation whose proxy
    endpoint is called.
    """

    peer: Peer
    caller_id: str
    arrived: int
    own: bool = False
    target: Incarnation | None = None

    def as_named(self, caller_id: str) -> "Caller":
        return Caller(self.peer, caller_id, self.arrived, self.own, self.target)

    @property
    def asker(self) -> Asker:
        return Asker(
            self.peer.text, self.caller_id, self.arrived, None if self.target is None else self.target.name
        )
