"""Everything with which a feature registers nodes at RVMaster, as if they had registered themselves."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.policy.model import Address
from roswire.xmlrpc import Value


@dataclass(frozen=True, slots=True)
class Registrar:
    """`call(host, local, method, parameters)` makes a call of the Master API as if a node of this host had made it at
    the appliance's address `local`. It is decided, charged and recorded in the same way.
    """

    registry: Registry
    graph: RosGraph
    subscribers: Subscribers
    parameters: ParameterCalls
    flush: Callable[[], None]
    call: Callable[[Address, str, str, tuple[Value, ...]], Awaitable[Value]]
    ready: Callable[[], Awaitable[object]]
    """Waits until the ROS master has all registrations."""
    silence: Callable[[], None]
    """Sends nothing more to nodes, until `speak`."""
    speak: Callable[[], None]
