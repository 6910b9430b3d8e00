"""What the appliance's own node may do: rosout, a C++ program that parses what every node logs.

It is no part of what the policy speaks of, and not trusted either: it may register as `/rosout` what an unmodified
rosout registers, look for the parameters that roscpp looks for when it starts, and nothing else.
"""

from dataclasses import dataclass

from appliance.master.calls.call import Call
from appliance.master.graph.registry import Kind
from appliance.policy.model import Decision

OWN = "the appliance's own node"


@dataclass(frozen=True, slots=True)
class OwnNode:
    """The rights of one node of the appliance."""

    name: str
    resources: dict[Kind, frozenset[str]]
    parameters: frozenset[str]

    def decide(self, caller_id: str, call: Call, arguments: tuple[object, ...]) -> Decision:
        """Whether it may make this call of the Master API with these canonical arguments."""
        kind = call.registers or call.gives_up
        if caller_id != self.name:
            what = f"speak as {caller_id[:80] or 'nobody'}"
        elif kind is not None and call.resource is not None:
            if self.may_have(kind, str(arguments[call.resource])):
                return Decision(True, None, OWN)
            what = f"have the {kind} {arguments[call.resource]}"
        elif call.name in _LOOKS_FOR:
            if arguments[0] in self.parameters:
                return Decision(True, None, OWN)
            what = f"read the parameter {arguments[0]}"
        else:
            what = f"call {call.name}"
        return Decision(False, None, f"{self.name} is {OWN} and may not {what}")

    def may_have(self, kind: Kind, resource: str) -> bool:
        """Whether it may have a registration."""
        return resource in self.resources.get(kind, ())


_LOOKS_FOR = frozenset({"hasParam", "getParam"})
ROSOUT = OwnNode(
    name="/rosout",
    resources={
        Kind.PUBLICATION: frozenset({"/rosout_agg"}),
        Kind.SUBSCRIPTION: frozenset({"/rosout"}),
        Kind.SERVICE: frozenset({"/rosout/get_loggers", "/rosout/set_logger_level"}),
    },
    parameters=frozenset(
        {
            "/enable_statistics",
            "/statistics_window_max_elements",
            "/statistics_window_max_size",
            "/statistics_window_min_elements",
            "/statistics_window_min_size",
            "/tcp_keepalive",
            "/use_sim_time",
        }
    ),
)
