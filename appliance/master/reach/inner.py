"""The inner face: what ROSMaster calls. It is acknowledged, and nothing follows from it.

What nodes are told is made by `graph` when a call that was decided is carried out: lists of publishers from the
registry, values of parameters from the call's key and value, the order to shut down from who took the name. What
ROSMaster says of these is a claim, which needs no reading: ROSMaster joins the names in a value into keys that nobody
was asked about, and its threads come late.
"""

from appliance.master.graph.registry import PUBLISHER_PATH, Registry
from appliance.master.reach.faces import key_of
from appliance.ros.xmlrpc import build_fault, build_response
from appliance.rpc.server import HttpRequest


class InnerFace:
    """Serves ROSMaster's calls to nodes. The path is the incarnation's key, which only ROSMaster was ever told."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry

    async def handle(self, request: HttpRequest) -> bytes:
        """Acknowledge one call of ROSMaster."""
        if request.path != PUBLISHER_PATH and self._registry.by_key(key_of(request)) is None:
            return build_fault(1, "nobody is here")
        return build_response([1, "", 0])
