"""PolicyDraft a policy that keeps the surveyed graph as it is, grouped as a person would write it. No I/O.

1. The machine of the ROS master becomes `robot` and keeps everything that it may do today, also what was not seen.
   Each other host gets what its nodes have registered, and calls that only read.
2. In a section, only the most specific key that matches decides. So a key is written where its hosts differ from those
   of the key above it, and names with the same hosts below one prefix become one key.
3. A graph does not say who calls a service, or reads and writes a parameter. There, all hosts of the graph keep what
   they may do today, and a comment says so.
4. The draft is decided by the product's own policy before it is returned: each right that was seen is allowed, and an
   unknown host gets nothing.
"""

import ipaddress
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.policy.cases import run_cases
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.graph_inventory import GraphInventory
from roswire.names import is_global_name

ROBOT = "robot"
_UNKNOWN = "192.0.2.99"  # an address of TEST-NET-1, which no host has
_GROUP = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,60}", re.ASCII)
_RESERVED = {ROBOT, "default", "ask"}
_FEW = 2  # names with the same hosts that are worth a pattern

Hosts = frozenset[str]
Rights = Mapping[str, Hosts]


class DraftError(Exception):
    """The draft does not keep the graph as it is; the message names the rights."""


class PolicyDraft(NamedTuple):
    """A policy and its tests. `left_out` has names that no key can be written for."""

    text: str
    tests: str
    left_out: tuple[str, ...]


def draft(inventory: GraphInventory, names: Mapping[str, str]) -> PolicyDraft:
    """Return a draft. `names` has the names of addresses, as in /etc/hosts. Raises `DraftError`."""
    groups = _groups(inventory, names)
    left_out: list[str] = []
    named: dict[str, Iterable[tuple[str, Iterable[str]]]] = {
        "Nodes": [(_lasting(node.name), [node.name]) for node in inventory.nodes],
        "Publishers": [(topic.name, topic.publishers) for topic in inventory.topics],
        "Subscribers": [(topic.name, topic.subscribers) for topic in inventory.topics],
        "Services": [(service.name, service.providers) for service in inventory.services],
    }
    sections = {section: _rights(rows, inventory, groups, left_out) for section, rows in named.items()}
    text = "".join(_text(inventory, groups, sections))
    tests = "".join(_tests(inventory, groups))
    _check(text, tests, _address_of_robot(inventory))
    return PolicyDraft(text, tests, tuple(sorted(set(left_out))))


def _groups(inventory: GraphInventory, names: Mapping[str, str]) -> dict[str, str]:
    """Return the group of each address."""
    groups = dict.fromkeys((inventory.master_host, *inventory.own, "127.0.0.1", "::1"), ROBOT)
    addresses = {node.host for node in inventory.nodes if node.host} - groups.keys()
    for address in sorted(addresses, key=lambda one: (":" in one, ipaddress.ip_address(one).packed)):
        if ipaddress.ip_address(address).is_loopback:
            groups[address] = ROBOT
            continue
        name = names.get(address, "").partition(".")[0]
        good = _GROUP.fullmatch(name) and name not in {*_RESERVED, *groups.values()}
        numbered = (f"host-{number}" for number in itertools.count(len(set(groups.values()))))
        groups[address] = name if good else next(one for one in numbered if one not in groups.values())
    return groups


def _lasting(node: str) -> str:
    """Return the key of a node's name: an anonymous name is another one at the next start."""
    words = node.split("_")
    numbers = sum(len(word) > 2 and word.isdigit() for word in words[-2:])
    lasting = len(words) > numbers > 0 and words[-1].isdigit() and len(words[-1]) > 2
    return "_".join([*words[:-numbers], "*"]) if lasting else node


def _rights(
    rows: Iterable[tuple[str, Iterable[str]]],
    inventory: GraphInventory,
    groups: Mapping[str, str],
    left_out: list[str],
) -> Rights:
    addresses = inventory.hosts
    rights: dict[str, set[str]] = {}
    for name, nodes in rows:
        hosts = {groups[addresses[node]] for node in nodes if addresses.get(node)}
        if not is_global_name(name.removesuffix("*")):
            left_out.append(name)
        elif hosts:
            rights.setdefault(name, set()).update(hosts)
    return {name: frozenset(hosts) for name, hosts in rights.items()}


@dataclass
class _Level:
    """The names with a common beginning; `own` are the hosts of the name that is the beginning itself."""

    own: Hosts | None = None
    below: dict[str, "_Level"] = field(default_factory=dict)

    def all(self) -> Iterator[Hosts]:
        if self.own is not None:
            yield self.own
        for level in self.below.values():
            yield from level.all()


def keys_of(rights: Rights) -> dict[str, Hosts]:
    """Return the fewest keys of one section that this grouping finds, `default` first."""
    root = _Level()
    for name, hosts in rights.items():
        level = root
        for part in name.strip("/").split("/"):
            level = level.below.setdefault(part, _Level())
        level.own = hosts
    default = _commonest(root) or frozenset({ROBOT})
    if ROBOT not in default:
        default = frozenset({ROBOT})
    return {"default": default, **dict(_keys(root, "", default))}


def _commonest(level: _Level) -> Hosts | None:
    counts = Counter(level.all())
    return min(counts, key=lambda hosts: (-counts[hosts], len(hosts), sorted(hosts))) if counts else None


def _keys(level: _Level, prefix: str, inherited: Hosts) -> Iterator[tuple[str, Hosts]]:
    hosts = _commonest(level)
    if (
        prefix
        and hosts is not None
        and hosts != inherited
        and sum(one == hosts for one in level.all()) >= _FEW
    ):
        yield f"{prefix}/**", hosts
        inherited = hosts
    if level.own is not None and level.own != inherited:
        yield prefix, level.own
    for part, below in sorted(level.below.items()):
        yield from _keys(below, f"{prefix}/{part}", inherited)


def _text(
    inventory: GraphInventory, groups: Mapping[str, str], sections: Mapping[str, Rights]
) -> Iterator[str]:
    others = {group: address for address, group in groups.items() if group != ROBOT}
    everyone = " ".join([ROBOT, *others])
    yield f"# Drafted from the graph of {inventory.master}: review it, and name its groups.\n"
    where = inventory.master_host or "unknown"
    yield f"# robot is the machine of the ROS master ({where}); it may do what it may today.\n"
    if others:
        width = max(map(len, others))
        yield "\n[Groups]\n"
        yield from (f"{group:<{width}} = {address}\n" for group, address in others.items())
    for section, rights in sections.items():
        keys = keys_of(rights)
        width = max(map(len, keys))
        yield f"\n[{section}]\n"
        yield from (
            f"{key:<{width}} = {' '.join(sorted(hosts, key=_robot_first))}\n" for key, hosts in keys.items()
        )
    yield "\n[Clients]                     # the graph does not say who calls a service\n"
    yield f"default = {everyone}\n"
    yield "\n[Parameters]                  # nor who reads or writes a parameter\n"
    yield f"read  /** = {everyone}\nwrite /** = {everyone}\n"
    yield "\n[Commands]\n"
    yield f"default  = {everyone}\nshutdown = {ROBOT}\n"


def _robot_first(group: str) -> tuple[bool, str]:
    return group != ROBOT, group


def _tests(inventory: GraphInventory, groups: Mapping[str, str]) -> Iterator[str]:
    addresses = inventory.hosts
    rows: dict[str, list[str]] = {
        node.name: [f"use-node {node.name}"] for node in inventory.nodes if node.host
    }
    for action, named in (
        ("publish", ((topic.name, topic.publishers) for topic in inventory.topics)),
        ("subscribe", ((topic.name, topic.subscribers) for topic in inventory.topics)),
        ("offer", ((service.name, service.providers) for service in inventory.services)),
    ):
        for name, nodes in named:
            for node in nodes:
                if node in rows and is_global_name(name):
                    rows[node].append(f"{action} {name}")
    yield f"# The rights in the graph of {inventory.master}, which no other host gets.\n"
    yield f'given:\n  robot: "{_address_of_robot(inventory)}"\n\ncases:\n'
    for node, actions in sorted(rows.items()):
        if is_global_name(node):
            group = groups[addresses[node]]
            host = ROBOT if group == ROBOT else addresses[node]
            yield f'  - host: "{host}"\n    node: {node}\n    allow:\n'
            yield from (f"      - {action}\n" for action in actions)
    yield f'  - host: "{_UNKNOWN}"\n    node: /visitor\n    deny:\n'
    yield "      - use-node /visitor\n      - command getSystemState\n"
    topics = [topic.name for topic in inventory.topics if is_global_name(topic.name)][:1]
    yield from (f"      - publish {name}\n      - subscribe {name}\n" for name in topics)


def _address_of_robot(inventory: GraphInventory) -> str:
    """Return the address for the tests: on the robot itself, the master's name is often that of the loopback."""
    try:
        loopback = ipaddress.ip_address(inventory.master_host).is_loopback
    except ValueError:
        loopback = True
    return "192.0.2.10" if loopback else inventory.master_host


def _check(text: str, tests: str, robot: str) -> None:
    policy = compile_policy(text, file="draft.ini", robot=[ipaddress.ip_address(robot)])
    wrong = [result for result in run_cases(policy, tests, "draft.ini.tests.yaml") if not result.passed]
    if wrong:
        rows = ", ".join(f"{row.request.category.value} {row.request.resource}" for row in wrong[:5])
        raise DraftError(
            f"the draft would decide these calls of the present graph differently: {rows}; report this defect, and"
            " write the policy by hand"
        )
