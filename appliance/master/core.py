"""What a call is performed with: the parts of RVMaster, named once."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.calls.gate import Gate
from appliance.master.calls.parameters import ParameterMirror
from appliance.master.graph.graph import Graph
from appliance.master.graph.liveness import Liveness
from appliance.master.graph.registry import Registry
from appliance.master.reach.addresses import Addresses
from appliance.master.reach.faces import Faces
from appliance.master.reach.mediation import Mediation
from appliance.master.reach.relays import RelayControl
from appliance.master.rosmaster import RosMaster
from appliance.policy import Policy
from appliance.policy.model import Address
from appliance.recorder import Recorder
from appliance.specifications.monitors import Monitors


@dataclass(slots=True)
class Master:
    """The parts of RVMaster; `port` is its own, `stop(reason)` ends the appliance.

    `publish_as` is the node that publishes what monitors publish; `redecide_for(host, caller_id)` takes back what
    the policy in force does not allow one caller, after a call of his that was decided by an earlier one.
    """

    port: int
    registry: Registry
    gate: Gate
    recorder: Recorder
    rosmaster: RosMaster
    relay: RelayControl
    graph: Graph
    faces: Faces
    liveness: Liveness
    parameters: ParameterMirror
    mediation: Mediation
    monitors: Monitors
    publish_as: str
    hide_publisher: bool
    addresses: Addresses
    policy: Callable[[], Policy]
    stop: Callable[[str], None]
    redecide_for: Callable[[Address, str], int]
