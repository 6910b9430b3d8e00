"""The inner face: what ROSMaster calls. It is acknowledged at once and delivered from the node's own queue.

The path of the request is the incarnation's key, which only ROSMaster was ever told. Lists of publishers are not
taken from here (`graph` makes them from the registry, when it changes); a list for a topic is only the sign that
ROSMaster saw a change. A parameter's value goes the way of all that nodes are told of them (`Graph.tell_parameter`).
"""

from collections.abc import Callable

import structlog

from appliance.master.delivery import Delivery, NodeCall
from appliance.master.faces import key_of
from appliance.master.http import HttpRequest
from appliance.master.registry import PUBLISHER_PATH, Incarnation, Registry
from appliance.ros.errors import PeerError
from appliance.ros.xmlrpc import Limits, MethodCall, Value, build_fault, build_response, parse_call

_log = structlog.get_logger()


class InnerFace:
    """Serves ROSMaster's calls to nodes. `tell_parameter(node, key, value, size)` passes a new value on."""

    def __init__(
        self,
        registry: Registry,
        delivery: Delivery,
        limits: Limits,
        *,
        tell_parameter: Callable[[Incarnation, str, Value, int], None],
    ) -> None:
        self._tell_parameter = tell_parameter
        self._registry = registry
        self._delivery = delivery
        self._limits = limits

    async def handle(self, request: HttpRequest) -> bytes:
        """Answer one call of ROSMaster."""
        if request.path == PUBLISHER_PATH:
            return build_response([1, "", 0])
        incarnation = self._registry.by_key(key_of(request))
        if incarnation is None:
            return build_fault(1, "nobody is here")
        try:
            call = parse_call(request.body, self._limits)
        except PeerError as error:
            _log.error("ROSMaster's call was not understood", error=str(error))
            return build_fault(1, str(error))
        return build_response(self._answer(incarnation, call, len(request.body)))

    def _answer(self, incarnation: Incarnation, call: MethodCall, size: int) -> Value:
        match call.method, call.params:
            case "publisherUpdate", _:
                return [1, "", 0]
            case "paramUpdate", (_, str(key), value):
                self._tell_parameter(incarnation, key, value, size)
                return [1, "", 0]
            case "shutdown", (_, str(reason)):
                self._delivery.push(incarnation, NodeCall("shutdown", (reason,)))
                return [1, "", 0]
            case "getPid", _:
                return [1, "", 0]
        return [0, f"{call.method} is not a call of a master", 0]
