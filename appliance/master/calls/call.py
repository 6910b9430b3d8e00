"""The nouns of RVMaster: a row of the table of calls, who calls, and the answer.

`calls.py` has the Master API's rows, `node_calls.py` those of the outer face.
"""

import enum
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.master.calls.arguments import Parameter
from appliance.master.graph.registry import Incarnation, Kind
from appliance.policy.model import Category, Decision, told_of
from appliance.policy.rights import category_of, touch_of
from appliance.recorder import Asker
from appliance.ros.xmlrpc import Value
from appliance.rpc.server import Peer

if TYPE_CHECKING:
    from appliance.master.core import Master

Answer = list[Value]
"""What a call returns: `[code, message, value]`; code 1 done, 0 failed or denied, -1 the caller's error."""

Perform = Callable[["Master", "Caller", tuple[object, ...]], Awaitable[Value]]


def denial_text(decision: Decision, record: str, tell: str) -> str:
    """What a denied caller is told: as much of the reason as the policy lets be told, and the record's id."""
    return f"{told_of(decision, tell)} [{record}]"


class LimitReachedError(Exception):
    """A call would take more than there is for all hosts; the text says what of."""


class Identity(enum.Enum):
    """What a call claims by its `caller_id`, and so what is checked of it."""

    NODE = "node"  # makes the node part of the graph: [Nodes] must grant the name, nobody else may hold it
    FREE = "free"  # nobody else may hold the name; it need not be a node's
    NOBODY = "nobody"  # the call has no caller_id


@dataclass(frozen=True, slots=True)
class Caller:
    """Who makes a call: the peer, and the `caller_id` he claims.

    `own` marks the appliance's own nodes, which reach RVMaster on a listener of their own. `target` is set on an
    outer face: the incarnation that the call is for.
    """

    peer: Peer
    caller_id: str
    arrived: int
    own: bool = False
    target: Incarnation | None = None

    @property
    def asker(self) -> Asker:
        """The caller as the audit log has him."""
        return Asker(
            self.peer.text, self.caller_id, self.arrived, None if self.target is None else self.target.name
        )


@dataclass(frozen=True, slots=True)
class Call:
    """One row of a table of calls.

    parameters  what follows the caller_id
    denial      the value of a denied answer: of the type the call returns, so that no client library stumbles over it
    identity    what is checked of the caller_id; `reads`: the call only reads, an empty one will do
    resource    which parameter it is about: a topic, a service, or a ROS parameter's key
    command     the name that the policy knows it by, where that is another (`policy/rights` says what it needs)
    api         which parameter is the node's API URI
    registers   what a node has from then on; `gives_up`: what it has no more
    """

    name: str
    perform: Perform
    parameters: tuple[Parameter, ...] = ()
    denial: Value = 0
    identity: Identity = Identity.FREE
    resource: int | None = None
    command: str | None = None
    api: int | None = None
    registers: Kind | None = None
    gives_up: Kind | None = None
    reads: bool = False

    @property
    def category(self) -> Category:
        """What kind of thing it is decided and recorded as."""
        return category_of(self.policy_name)

    @property
    def touches(self) -> Category | None:
        """Whether it reads or writes the ROS parameter that it is about."""
        return touch_of(self.policy_name)

    @property
    def policy_name(self) -> str:
        """The name that the policy knows it by."""
        return self.command or self.name
