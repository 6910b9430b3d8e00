"""Which relay process carries which topic and service, and has which file of specifications.

Files whose specifications share topics, services or variables, or publish onto each other's topics, are a *group* and
stay together with everything they touch, so that every message meets all its monitors in one process. A topic or
service without a specification goes by its name.

Invariants:

1. A topic (a service) is carried by exactly one relay at any time, for all its publishers.
2. What is carried stays where it is for as long as it can: a plan moves as few running monitors as possible, then as
   few topics and services that are carried now. Only then loads are evened out.
3. The allocation survives the death of control, as connections in the relays do.
"""

import json
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

from appliance.master.specifications import Checked

TOPIC, SERVICE = "topic", "service"
Resource = tuple[str, str]
"""`TOPIC` or `SERVICE`, and a name."""


@dataclass(frozen=True, slots=True)
class Group:
    """Files that stay together, with how many specifications each has, and what they touch."""

    files: Mapping[str, int]
    resources: frozenset[Resource]

    @property
    def specifications(self) -> int:
        """How many monitors there are."""
        return sum(self.files.values())


@dataclass(frozen=True, slots=True)
class Move:
    """A topic or service that is carried now, from one relay to another."""

    kind: str
    name: str
    source: int
    target: int


@dataclass(frozen=True, slots=True)
class Plan:
    """An allocation that can be adopted: files and resources by relay, what moves, and the monitors that move."""

    files: Mapping[str, int] = field(default_factory=dict)
    resources: Mapping[Resource, int] = field(default_factory=dict)
    moves: tuple[Move, ...] = ()
    moved_files: frozenset[str] = frozenset()


class Allocation:
    """The allocation in force over so many relays; `save(text)` keeps it."""

    def __init__(self, relays: int, save: Callable[[str], None] = lambda _text: None) -> None:
        self.relays = relays
        self._save = save
        self._plan = Plan()

    def of(self, kind: str, name: str) -> int:
        """The relay of a topic or service."""
        return self._of(self._plan.resources, (kind, name))

    def of_file(self, file: str) -> int:
        """The relay that has a file of specifications."""
        return self._plan.files.get(file, 0)

    def restore(self, text: str) -> bool:
        """Take the allocation that was kept; False if it is of another number of relays, or unreadable."""
        try:
            kept = json.loads(text)
            plan = Plan(
                {str(name): int(relay) for name, relay in kept["files"]},
                {(str(kind), str(name)): int(relay) for kind, name, relay in kept["resources"]},
            )
        except (ValueError, KeyError, TypeError):
            return False
        if kept["relays"] != self.relays:
            return False
        self._plan = plan
        return True

    def plan(self, checked: Checked, carried: Collection[Resource] = ()) -> Plan:
        """The allocation for these specifications, while these topics and services are carried."""
        before, carried = self._plan, set(carried)
        files: dict[str, int] = {}
        resources: dict[Resource, int] = {}
        loads = [0] * self.relays
        for group in groups_of(checked):
            costs = [(*self._cost(group, one, carried), loads[one], one) for one in range(self.relays)]
            relay = min(costs)[-1]
            loads[relay] += group.specifications
            files.update(dict.fromkeys(group.files, relay))
            resources.update(dict.fromkeys(group.resources, relay))
        for resource in carried:  # what no specification touches stays where it is
            here = self._of(before.resources, resource)
            if resource not in resources and here != self._by_name(resource):
                resources[resource] = here
        moves = tuple(
            Move(*resource, source, target)
            for resource in sorted(carried)
            if (source := self._of(before.resources, resource)) != (target := self._of(resources, resource))
        )
        moved = frozenset(name for name, relay in files.items() if before.files.get(name, relay) != relay)
        return Plan(files, resources, moves, moved)

    def adopt(self, plan: Plan) -> None:
        """This is the allocation from now on."""
        self._plan = plan
        kept = {
            "relays": self.relays,
            "files": sorted(plan.files.items()),
            "resources": sorted((*resource, relay) for resource, relay in plan.resources.items()),
        }
        self._save(json.dumps(kept))

    def _cost(self, group: Group, relay: int, carried: Collection[Resource]) -> tuple[int, int]:
        """The monitors, and the carried topics and services, that would have to move there."""
        here = self._plan.files
        return sum(count for name, count in group.files.items() if here.get(name, relay) != relay), sum(
            one in carried and self._of(self._plan.resources, one) != relay for one in group.resources
        )

    def _of(self, resources: Mapping[Resource, int], resource: Resource) -> int:
        found = resources.get(resource)
        return self._by_name(resource) if found is None else found

    def _by_name(self, resource: Resource) -> int:
        return zlib.crc32(resource[1].encode()) % self.relays


def groups_of(checked: Checked) -> list[Group]:
    """The groups, the largest first; in the order of their files' names where they are as large."""
    touched: dict[str, set[Resource]] = {file: set() for file in checked.monitors.values()}
    for name, file in checked.monitors.items():
        touched[file] |= {(TOPIC, one) for one in checked.topics[name]}
        touched[file] |= {(SERVICE, one) for one in checked.services[name]}
    for file, topics in checked.published_by.items():
        touched[file] |= {(TOPIC, one) for one in topics}
    counts = Counter(checked.monitors.values())
    groups = [
        Group(
            {file: counts[file] for file in files}, frozenset(one for file in files for one in touched[file])
        )
        for files in _join(touched, checked)
    ]
    return sorted(groups, key=lambda group: (-group.specifications, sorted(group.files)))


def _join(touched: Mapping[str, Iterable[Resource]], checked: Checked) -> list[set[str]]:
    """Files that are connected by a topic, a service or a variable, however indirectly."""
    group = {file: {file} for file in touched}

    def join(one: str, other: str) -> None:
        if group[one] is not group[other]:
            group[one] |= group[other]
            for file in group[other]:
                group[file] = group[one]

    owner: dict[Resource, str] = {}
    for file, resources in touched.items():
        for resource in resources:
            join(owner.setdefault(resource, file), file)
    for name, others in checked.uses.items():
        for other in others:
            join(checked.monitors[name], checked.monitors[other])
    return list({id(files): files for files in group.values()}.values())
