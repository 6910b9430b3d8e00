"""Define the rights of the appliance's own node: rosout, a C++ program that parses the log messages of all nodes.

rosout is not trusted. It may only make the registrations of an unmodified rosout, and read the parameters that roscpp
reads at its start.
"""

from appliance.master.graph.registry import Kind

OWN = "the appliance's own node"
ROSOUT = "/rosout"
_RESOURCES = {
    Kind.PUBLICATION: frozenset({"/rosout_agg"}),
    Kind.SUBSCRIPTION: frozenset({"/rosout"}),
    Kind.SERVICE: frozenset({"/rosout/get_loggers", "/rosout/set_logger_level"}),
}
PARAMETERS = frozenset(
    {
        "/enable_statistics",
        "/statistics_window_max_elements",
        "/statistics_window_max_size",
        "/statistics_window_min_elements",
        "/statistics_window_min_size",
        "/tcp_keepalive",
        "/use_sim_time",
    }
)


def rosout_may_have(kind: Kind, resource: str) -> bool:
    return resource in _RESOURCES.get(kind, ())
