"""The nouns of RVMaster: a row of the table of calls, who calls, and the answer.

`calls.py` has the Master API's rows, `node_calls.py` those of the outer face.
"""

import enum
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.master.arguments import Parameter
from appliance.master.http import Peer
from appliance.master.registry import Incarnation
from appliance.policy.model import Category, Decision
from appliance.ros.xmlrpc import Value

if TYPE_CHECKING:
    from appliance.master.core import Master

Answer = list[Value]
"""What a call returns: `[code, message, value]`; code 1 done, 0 failed or denied, -1 the caller's error."""

Perform = Callable[["Master", "Caller", tuple[object, ...]], Awaitable[Value]]


def denial_text(decision: Decision, record: str) -> str:
    """What a denied caller is told: the reason, which names the rule and where it stands, and the record's id."""
    return f"{decision.reason} [{record}]"


class LimitReachedError(Exception):
    """A call would take more than there is for all hosts; the text says what of."""


class Identity(enum.Enum):
    """What a call claims by its `caller_id`, and so what is checked of it."""

    NODE = "node"  # makes the node part of the graph: [Nodes] must grant the name, nobody else may hold it
    FREE = "free"  # nobody else may hold the name; it need not be a node's
    NOBODY = "nobody"  # the call has no caller_id


class Touch(enum.Enum):
    """How a call touches a parameter, for `[Parameters]`."""

    READ = "read"
    WRITE = "write"


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


@dataclass(frozen=True, slots=True)
class Call:
    """One row of a table of calls.

    parameters  what follows the caller_id; the last `optional` of them may be left out
    denial      the value of a denied answer: of the type the call returns, so that no client library stumbles over it
    identity    what is checked of the caller_id; `reads`: the call only reads, an empty one will do
    category    what the policy is asked about, with the parameter at `resource`, or the call's own name as a command
    command     asked of `[Commands]` as well, or under this name
    touches     how it touches a parameter: asked of `[Parameters]` as well, when the policy has it
    api         which parameter is the node's API URI
    """

    name: str
    perform: Perform
    parameters: tuple[Parameter, ...] = ()
    optional: int = 0
    denial: Value = 0
    identity: Identity = Identity.FREE
    category: Category = Category.COMMAND
    resource: int | None = None
    command: str | None = None
    touches: Touch | None = None
    api: int | None = None
    reads: bool = False
