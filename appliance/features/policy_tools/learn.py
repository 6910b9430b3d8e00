"""Learn a least-privilege policy from the recorded decisions of a robot.

Each used right is granted to the hosts that used it. Four keys are wider than observed, because the next run
needs them:

1. A name of one run becomes a pattern: `/rostopic_*` for the anonymous node `/rostopic_4711_1700000000000`, and
   `/roslaunch/uris/**` for the port of a `roslaunch`. A parameter below such a name becomes its namespace.
2. `searchParam` needs the right to find every parameter that it tries: the next run may have it, and a search
   without that right is denied.
3. The key of a parameter becomes the key of its namespace (`/arm` becomes `/arm/**`), because a call on a
   namespace needs the right on every parameter in it.

4. The services that set log levels become one key for all nodes (`/*/get_loggers`): every node offers them.

A host that used a right only with approvals is written after `ask`.
"""

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from appliance.features.policy_tools.stock_tools import key_of, name_for
from appliance.policy.actions import BadWordError, check_resource
from appliance.policy.commands import ALIASES
from appliance.policy.host_sets import Network, canonical_address
from appliance.policy.ini_reader import is_key
from appliance.policy.model import Address, Category, Request
from appliance.policy.rights import COMMAND_FOR, rights_of_call
from appliance.policy.sections import ASK, ASKING, DECIDERS, PARAMETERS
from roswire.names import candidate_keys, is_global_name

ROBOT = "robot"
"""The group of the appliance's own machine."""

_SHOWN_NODES = 3
_LOG_LEVELS = ("get_loggers", "set_logger_level")
_REGISTRATIONS = frozenset({"registerPublisher", "registerSubscriber", "registerService"})
_START_CALLS = ("getParam", "hasParam", "setParam", "getPid", "lookupNode")
"""The commands of a node, and of the `roslaunch` that starts it, at a start."""
_GROUP = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,60}+", re.ASCII)
_RESERVED = {ROBOT, "default", ASK}
_UNKNOWN = "192.0.2.99"  # an address of TEST-NET-1, which no host has


@dataclass(frozen=True, slots=True)
class Observation:
    """Equal requests of one record, that passed."""

    request: Request
    call: str = ""
    key: str = ""
    """The parameter of the call on the wire."""
    asked: bool = False
    """Whether it passed with an approval."""
    adopted: bool = False
    """Whether it was taken over from a ROS master, and the node did not make the call itself."""
    count: int = 1
    """The number of such requests."""


@dataclass(slots=True)
class _Right:
    hosts: set[Address] = field(default_factory=set)
    asked: set[Address] = field(default_factory=set)
    callers: set[tuple[Address, str]] = field(default_factory=set)
    used: int = 0

    @property
    def nodes(self) -> set[str]:
        return {node for _, node in self.callers}


_Rights = dict[tuple[Category, str], _Right]


@dataclass(frozen=True, slots=True)
class LearnedPolicy:
    """The policy and its tests. `left_out` is the number of requests that no rule can grant.

    `unstarted` has the nodes that were taken over while they ran, and were not seen to start. `keys` are the keys of
    the text, each with its hosts.
    """

    text: str
    tests: str
    requests: int
    left_out: int
    unstarted: tuple[str, ...]
    keys: tuple[tuple[str, frozenset[Address]], ...]


def learn(
    observations: Iterable[Observation],
    robot: Collection[Address | Network] = (),
    names: Mapping[str, str] | None = None,
    *,
    with_start: bool = False,
) -> LearnedPolicy:
    """Return the policy. `names` has the names of addresses, as in /etc/hosts.

    With `with_start`, nodes that were not seen to start may do what every node does at its start, and their hosts may
    set parameters, as a launch file does.
    """
    rights: _Rights = {}
    starts: dict[str, dict[Address, bool]] = {}
    requests = left_out = 0
    for observation in observations:
        try:
            needed = list(needed_rights(observation))
        except BadWordError:
            needed = []
        if not needed or not all(is_key(request.resource) for request in needed):
            left_out += observation.count
            continue
        requests += observation.count
        host, node = canonical_address(observation.request.host), key_of(observation.request.caller_id)
        if observation.call in _REGISTRATIONS:
            its = starts.setdefault(node, {})
            its[host] = its.get(host, False) or not observation.adopted
        for request in needed:
            _add(rights, request, asked=observation.asked, used=observation.count)
    unstarted = {node: hosts for node, hosts in starts.items() if not all(hosts.values())}
    if with_start:
        for node, hosts in unstarted.items():
            for host in (host for host, started in hosts.items() if not started):
                for request in _of_start(host, node):
                    _add(rights, request, used=0)
    _join_log_levels(rights)
    _hand_down(rights)
    needful = _needful(rights)
    named = _names(needful, robot, names or {})
    remark = sorted(unstarted) if with_start else []
    return LearnedPolicy(
        "".join(_text(needful, named, remark)),
        "".join(_tests(needful, named)),
        requests,
        left_out,
        tuple(sorted(unstarted)),
        tuple((key, frozenset(right.hosts | right.asked)) for (_, key), right in needful.items()),
    )


def _add(rights: _Rights, request: Request, *, asked: bool = False, used: int = 1) -> None:
    right = rights.setdefault((request.category, _key(request)), _Right())
    right.used += used
    asked = asked and request.category in ASKING
    (right.asked if asked else right.hosts).add(canonical_address(request.host))
    if is_global_name(request.caller_id):
        right.callers.add((canonical_address(request.host), key_of(request.caller_id)))


def _of_start(host: Address, node: str) -> Iterator[Request]:
    for call in _START_CALLS:
        yield Request(host, node, Category.COMMAND, call)
    for category in (Category.READ, Category.WRITE):
        yield Request(host, node, category, "/")
    yield Request(host, node, Category.PUBLISH, "/rosout")
    yield Request(host, node, Category.NODE, node)


def _join_log_levels(rights: _Rights) -> None:
    """Replace the keys of these services of at least two nodes by one, with the hosts of all."""
    alike: dict[tuple[Category, str], list[str]] = {}
    for category, key in rights:
        *levels, service = key.split("/")
        if category in (Category.OFFER, Category.CALL) and service in _LOG_LEVELS:
            alike.setdefault(
                (category, "/".join([*("*" if level else "" for level in levels), service])), []
            ).append(key)
    for (category, joined), keys in alike.items():
        if len(keys) > 1:
            merged = _Right()
            for key in keys:
                right = rights.pop((category, key))
                merged.hosts |= right.hosts
                merged.asked |= right.asked
                merged.callers |= right.callers
                merged.used += right.used
            rights[category, joined] = merged


def is_covered(given: Network, places: Iterable[Network]) -> bool:
    return any(
        given.version == place.version and given.subnet_of(place)  # type: ignore[arg-type]  # both are of one version
        for place in places
    )


def needed_rights(observation: Observation) -> Iterator[Request]:
    """Yield the requests that rules must grant. Raises `BadWordError` for a name or call that no rule can grant."""
    for right in rights_of_call(observation.request, observation.call, observation.key or None):
        check_resource(right.request.category, right.request.resource)
        yield right.request
    if observation.call == "searchParam":
        request = observation.request
        for name in candidate_keys(observation.key, request.caller_id):
            check_resource(Category.READ, name)
            yield Request(request.host, request.caller_id, Category.READ, name)


def lasting_name(request: Request) -> str:
    """Return the resource, with a pattern for a name of one run."""
    return request.resource if request.category is Category.COMMAND else key_of(request.resource)


def _key(request: Request) -> str:
    if request.category is Category.COMMAND:
        return ALIASES.get(request.resource, request.resource)
    name = lasting_name(request)
    if request.category not in PARAMETERS:
        return name
    before, star, _ = name.partition("*")  # two keys below a star can tie
    return f"{before}{star}".removesuffix("/*").rstrip("/") + "/**"


def _hand_down(rights: _Rights) -> None:
    """Add the hosts of a namespace to all narrower keys in it, because only the most specific key decides."""
    for (category, key), right in rights.items():
        if category in PARAMETERS:
            levels = key.removesuffix("/**").split("/")
            for length in range(1, len(levels)):
                above = rights.get((category, "/".join(levels[:length]) + "/**"))
                if above is not None:
                    right.hosts |= above.hosts
                    right.asked |= above.asked


def _needful(rights: _Rights) -> _Rights:
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


def _names(
    rights: _Rights, robot: Collection[Address | Network], names: Mapping[str, str]
) -> dict[Address, str]:
    """Return the word for each host: `robot`, the name of its address as a group, or the address."""
    hosts = {host for right in rights.values() for host in right.hosts | right.asked}
    words: dict[Address, str] = {}
    for host in sorted(hosts, key=_order):
        if any(_within(host, place) for place in robot):
            words[host] = ROBOT
            continue
        name = names.get(str(host), "").partition(".")[0]
        good = _GROUP.fullmatch(name) and name not in {*_RESERVED, *words.values()} and not host.is_loopback
        words[host] = name if good else str(host)
    return words


def _order(host: Address) -> tuple[int, int]:
    return host.version, int(host)


def _text(rights: _Rights, words: Mapping[Address, str], unstarted: Collection[str]) -> Iterator[str]:
    yield "# Learned from recorded actions: review it, name its groups, add its tests.\n"
    if unstarted:
        yield f"# Not seen to start: {', '.join(unstarted)}. So their hosts may read and write all parameters.\n"
    lists = {named: _hosts(right.hosts, words) for named, right in rights.items()}
    uses = Counter(others for _known, others in lists.values())
    shared = sorted(others for others, used in uses.items() if used > 1 and " " in others)
    groups = {others: f"hosts-{number}" for number, others in enumerate(shared, start=1)}
    single = {word: str(host) for host, word in words.items() if word not in (ROBOT, str(host))}
    if groups or single:
        yield "\n[Groups]\n"
        yield from (f"{name} = {address}\n" for name, address in single.items())
        yield from (f"{name} = {others}\n" for others, name in groups.items())
    for section in DECIDERS:
        yield f"\n[{section.name}]\n"
        for category in section.categories:
            keys = sorted(key for kind, key in rights if kind is category)
            width = max(map(len, keys), default=0)
            verb = f"{category.value} " if category in PARAMETERS else ""
            for key in keys:
                right, (known, others) = rights[category, key], lists[category, key]
                asked = _hosts(right.asked - right.hosts, words)
                who = " ".join(filter(None, [known, groups.get(others, others), ASK * any(asked), *asked]))
                nodes = "" if category is Category.NODE else f"{_nodes(right.nodes)} "
                used = f"({right.used}x)" if right.used else "(at a start)"
                yield f"{verb}{key:<{width}} = {who}  # {nodes.lstrip()}{used}\n"


def _hosts(hosts: set[Address], words: Mapping[Address, str]) -> tuple[str, str]:
    known = any(words[host] == ROBOT for host in hosts)
    rest = sorted((host for host in hosts if words[host] != ROBOT), key=_order)
    return ROBOT if known else "", " ".join(words[host] for host in rest)


def _tests(rights: _Rights, words: Mapping[Address, str]) -> Iterator[str]:
    """Yield a case for each host and node with its rights, and one for an unknown host with a right of each section."""
    yield "# What was used stays allowed, and an unknown host gets nothing of it.\n"
    members = [json.dumps(str(host)) for host, word in words.items() if word == ROBOT]
    if members:
        yield f"given:\n  robot: [{', '.join(members)}]\n"
    yield "\ncases:\n"
    for host in sorted(words, key=_order):
        for verdict in ("allow", "ask"):
            actions: dict[str, list[str]] = {}
            for (category, key), right in sorted(rights.items()):
                if host in (right.hosts if verdict == "allow" else right.asked - right.hosts):
                    command = COMMAND_FOR.get(category)
                    if command is None or host in _holders(rights, Category.COMMAND, command):
                        node = min((node for its, node in right.callers if its == host), default="/visitor")
                        actions.setdefault(node, []).append(_action(category, key))
            for node, its in sorted(actions.items()):
                yield f'  - host: "{host}"\n    node: {name_for(node)}\n    {verdict}:\n'
                yield from (f"      - {action}\n" for action in its)
    yield f'  - host: "{_UNKNOWN}"\n    node: /visitor\n    deny:\n      - use-node /visitor\n'
    firsts = dict(sorted(rights, reverse=True))
    yield from (
        f"      - {_action(category, key)}\n"
        for category, key in firsts.items()
        if category is not Category.NODE
    )


def _holders(rights: _Rights, category: Category, key: str) -> set[Address]:
    right = rights.get((category, key))
    return set() if right is None else right.hosts


def _action(category: Category, key: str) -> str:
    """Return the action on a name that the key matches."""
    verb = "use-node" if category is Category.NODE else category.value
    name = key.removesuffix("/**") or "/" if category in PARAMETERS else key
    action = f"{verb} {name_for(name)}"
    return json.dumps(action) if ":" in action else action  # YAML would read a mapping


def _within(host: Address, place: Address | Network) -> bool:
    return host == place if isinstance(place, Address) else host.version == place.version and host in place


def _nodes(nodes: set[str]) -> str:
    shown = sorted(nodes)[:_SHOWN_NODES]
    more = f" and {len(nodes) - len(shown)} more" if len(nodes) > len(shown) else ""
    return " ".join(shown) + more
