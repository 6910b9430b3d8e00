"""A least-privilege policy out of what a robot was seen to do.

Run the robot with `audit-only = all`, then learn from the decisions that were recorded: each right that was used is
granted to the hosts that used it, and nothing else. Two things are made wider than they were seen, because the next
run would not get by with less:

1. An anonymous node name (`/rostopic_4711_1700000000000`) becomes a pattern (`/rostopic_*`).
2. A parameter's key stands for what is below it as well (`/arm` becomes `/arm/**`), because a call on a namespace needs
   the right on everything in it. So a host that may touch a namespace may touch the narrower keys in it, too.

The result is for an engineer to read: every line says which nodes used the right.
"""

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

from appliance.policy.actions import BadWordError, check_resource
from appliance.policy.commands import ALIASES
from appliance.policy.hosts import Network, canonical_address
from appliance.policy.model import Address, Category, Request
from appliance.policy.rights import rights_of_call
from appliance.policy.sections import DECIDERS, PARAMETERS
from appliance.ros.names import is_global_name

# What rospy appends (process id and milliseconds) and what roscpp appends (nanoseconds).
_ANONYMOUS = re.compile(r"_[0-9]+_[0-9]{10,}$|_[0-9]{15,}$")
_SHOWN_NODES = 3


@dataclass(frozen=True, slots=True)
class Observation:
    """A request that passed, as it is recorded: `call` is its name on the wire, `key` the parameter it was about."""

    request: Request
    call: str = ""
    key: str = ""


@dataclass(slots=True)
class _Right:
    hosts: set[Address] = field(default_factory=set)
    nodes: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class Learned:
    """The policy as text; how many requests it stands on, how many were left out because no rule can grant them."""

    text: str
    requests: int
    left_out: int


def learn(observations: Iterable[Observation], robot: Collection[Address | Network] = ()) -> Learned:
    """The policy that grants what was observed; `robot` is what the group of that name means."""
    rights: dict[tuple[Category, str], _Right] = {}
    requests = left_out = 0
    for observation in observations:
        try:
            needed = list(_needed(observation))
        except BadWordError:
            left_out += 1
            continue
        requests += 1
        for request in needed:
            right = rights.setdefault((request.category, _key(request)), _Right())
            right.hosts.add(canonical_address(request.host))
            if is_global_name(request.caller_id):
                right.nodes.add(_without_numbers(request.caller_id))
    _hand_down(rights)
    return Learned("".join(_text(rights, robot)), requests, left_out)


def _needed(observation: Observation) -> Iterator[Request]:
    """Everything that must be granted for this request to pass. Raises `BadWordError` where no rule can."""
    for right in rights_of_call(observation.request, observation.call, observation.key or None):
        check_resource(right.request.category, right.request.resource)
        yield right.request


def _key(request: Request) -> str:
    if request.category is Category.COMMAND:
        return ALIASES.get(request.resource, request.resource)
    if request.category in PARAMETERS:
        return request.resource.rstrip("/") + "/**"
    return _without_numbers(request.resource)


def _without_numbers(name: str) -> str:
    return "/".join(_ANONYMOUS.sub("_*", level) for level in name.split("/"))


def _hand_down(rights: dict[tuple[Category, str], _Right]) -> None:
    """Give who may touch a namespace the narrower keys in it: the most specific key decides alone."""
    for (category, key), right in rights.items():
        if category in PARAMETERS:
            levels = key.removesuffix("/**").split("/")
            for length in range(1, len(levels)):
                above = rights.get((category, "/".join(levels[:length]) + "/**"))
                if above is not None:
                    right.hosts |= above.hosts


def _text(rights: dict[tuple[Category, str], _Right], robot: Collection[Address | Network]) -> Iterator[str]:
    yield "# Learned from what was seen to be done: read it, name the hosts in [Groups], add its tests.\n"
    for section in DECIDERS:
        yield f"\n[{section.name}]\n"
        for category in section.categories:
            lines = sorted(
                ((key, right) for (one, key), right in rights.items() if one is category),
                key=lambda line: line[0],
            )
            width = max((len(key) for key, _right in lines), default=0)
            verb = f"{category.value} " if category in PARAMETERS else ""
            for key, right in lines:
                comment = (
                    f"  # {_nodes(right.nodes)}" if right.nodes and category is not Category.NODE else ""
                )
                yield f"{verb}{key:<{width}} = {_hosts(right.hosts, robot)}{comment}\n"


def _hosts(hosts: set[Address], robot: Collection[Address | Network]) -> str:
    known = {host for host in hosts if any(_within(host, one) for one in robot)}
    rest = sorted(hosts - known, key=lambda host: (host.version, int(host)))
    return " ".join((["robot"] if known else []) + [str(host) for host in rest])


def _within(host: Address, place: Address | Network) -> bool:
    return host == place if isinstance(place, Address) else host.version == place.version and host in place


def _nodes(nodes: set[str]) -> str:
    shown = sorted(nodes)[:_SHOWN_NODES]
    more = f" and {len(nodes) - len(shown)} more" if len(nodes) > len(shown) else ""
    return " ".join(shown) + more
