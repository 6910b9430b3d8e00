"""What the appliance's own node may do: rosout, a C++ program that parses what every node logs.

It is no part of what the policy speaks of, and not trusted either: it may register as `/rosout` what an unmodified
rosout registers, look for the parameters that roscpp looks for when it starts, and nothing else.
"""

from dataclasses import dataclass

from appliance.master.graph.registry import Kind

OWN = "the appliance's own node"


@dataclass(frozen=True, slots=True)
class OwnNode:
    """The rights of one node of the appliance."""

    name: str
    resources: dict[Kind, frozenset[str]]
    parameters: frozenset[str]

    def may_have(self, kind: Kind, resource: str) -> bool:
        """Whether it may have a registration."""
        return resource in self.resources.get(kind, ())


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
