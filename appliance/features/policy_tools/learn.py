"""Learn a least-privilege policy from the recorded decisions of a robot.

Each used right is granted to the hosts that used it. Three keys are wider than observed, because the next run
needs them:

1. An anonymous node name (`/rostopic_4711_1700000000000`) becomes a pattern (`/rostopic_*`).
2. `searchParam` needs the right to find every parameter that it tries: the next run may have it, and a search
   without that right is denied.
3. The key of a parameter becomes the key of its namespace (`/arm` becomes `/arm/**`), because a call on a
   namespace needs the right on every parameter in it.

A host that used a right only with approvals is written after `ask`.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

from appliance.features.policy_tools.stock_tools import key_of
from appliance.policy.actions import BadWordError, check_resource
from appliance.policy.commands import ALIASES
from appliance.policy.host_sets import Network, canonical_address
from appliance.policy.model import Address, Category, Request
from appliance.policy.rights import rights_of_call
from appliance.policy.sections import ASK, ASKING, DECIDERS, PARAMETERS
from roswire.names import is_global_name, searched

_SHOWN_NODES = 3


@dataclass(frozen=True, slots=True)
class Observation:
    """A recorded request that passed."""

    request: Request
    call: str = ""
    key: str = ""
    """The parameter of the call on the wire."""
    asked: bool = False
    """Whether it passed with an approval."""


@dataclass(slots=True)
class _Right:
    hosts: set[Address] = field(default_factory=set)
    asked: set[Address] = field(default_factory=set)
    nodes: set[str] = field(default_factory=set)
    used: int = 0


@dataclass(frozen=True, slots=True)
class LearnedPolicy:
    """The policy; `left_out` is the number of requests that no rule can grant."""

    text: str
    requests: int
    left_out: int


def learn(observations: Iterable[Observation], robot: Collection[Address | Network] = ()) -> LearnedPolicy:
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
            right.used += 1
            asked = observation.asked and request.category in ASKING
            (right.asked if asked else right.hosts).add(canonical_address(request.host))
            if is_global_name(request.caller_id):
                right.nodes.add(key_of(request.caller_id))
    _hand_down(rights)
    return LearnedPolicy("".join(_text(_needful(rights), robot)), requests, left_out)


def covered(given: Network, places: Iterable[Network]) -> bool:
    return any(
        given.version == place.version and given.subnet_of(place)  # type: ignore[arg-type]  # both are of one version
        for place in places
    )


def _needed(observation: Observation) -> Iterator[Request]:
    for right in rights_of_call(observation.request, observation.call, observation.key or None):
        check_resource(right.request.category, right.request.resource)
        yield right.request
    if observation.call == "searchParam":
        request = observation.request
        for name in searched(observation.key, request.caller_id):
            check_resource(Category.READ, name)
            yield Request(request.host, request.caller_id, Category.READ, name)


def _key(request: Request) -> str:
    if request.category is Category.COMMAND:
        return ALIASES.get(request.resource, request.resource)
    if request.category in PARAMETERS:
        return request.resource.rstrip("/") + "/**"
    return key_of(request.resource)


def _hand_down(rights: dict[tuple[Category, str], _Right]) -> None:
    """Add the hosts of a namespace to all narrower keys in it, because only the most specific key decides."""
    for (category, key), right in rights.items():
        if category in PARAMETERS:
            levels = key.removesuffix("/**").split("/")
            for length in range(1, len(levels)):
                above = rights.get((category, "/".join(levels[:length]) + "/**"))
                if above is not None:
                    right.hosts |= above.hosts
                    right.asked |= above.asked


def _needful(rights: dict[tuple[Category, str], _Right]) -> dict[tuple[Category, str], _Right]:
    """Drop each parameter key that has the same hosts as the nearest key above it."""
    left = dict(rights)
    for (category, key), right in rights.items():
        levels = key.removesuffix("/**").split("/") if category in PARAMETERS else []
        above = (
            rights.get((category, "/".join(levels[:length]) + "/**"))
            for length in range(len(levels) - 1, 0, -1)
        )
        nearest = next(filter(None, above), None)
        if nearest is not None and (nearest.hosts, nearest.asked) == (right.hosts, right.asked):
            del left[category, key]
    return left


def _text(rights: dict[tuple[Category, str], _Right], robot: Collection[Address | Network]) -> Iterator[str]:
    yield "# Learned from recorded actions: review it, name its groups, add its tests.\n"
    hosts = {named: _hosts(right.hosts, robot) for named, right in rights.items()}
    lines = Counter(others for _known, others in hosts.values())
    shared = sorted(others for others, used in lines.items() if used > 1 and " " in others)
    groups = {others: f"hosts-{number}" for number, others in enumerate(shared, start=1)}
    if groups:
        yield "\n[Groups]\n"
        yield from (f"{name} = {others}\n" for others, name in groups.items())
    for section in DECIDERS:
        yield f"\n[{section.name}]\n"
        for category in section.categories:
            keys = sorted(key for kind, key in rights if kind is category)
            width = max(map(len, keys), default=0)
            verb = f"{category.value} " if category in PARAMETERS else ""
            for key in keys:
                right, (known, others) = rights[category, key], hosts[category, key]
                asked = _hosts(right.asked - right.hosts, robot)
                who = " ".join(filter(None, [known, groups.get(others, others), ASK * any(asked), *asked]))
                nodes = "" if category is Category.NODE else f"{_nodes(right.nodes)} "
                yield f"{verb}{key:<{width}} = {who}  # {nodes.lstrip()}({right.used}x)\n"


def _hosts(hosts: set[Address], robot: Collection[Address | Network]) -> tuple[str, str]:
    known = {host for host in hosts if any(_within(host, network) for network in robot)}
    rest = sorted(hosts - known, key=lambda host: (host.version, int(host)))
    return "robot" if known else "", " ".join(map(str, rest))


def _within(host: Address, place: Address | Network) -> bool:
    return host == place if isinstance(place, Address) else host.version == place.version and host in place


def _nodes(nodes: set[str]) -> str:
    shown = sorted(nodes)[:_SHOWN_NODES]
    more = f" and {len(nodes) - len(shown)} more" if len(nodes) > len(shown) else ""
    return " ".join(shown) + more
