"""Which relay process carries which topic and service, and has which file of specifications.

Files whose specifications share topics, services or variables, or publish onto each other's topics, are a *group* and
stay together with everything they touch, so that every message meets all its monitors in one process. A topic or
service without a specification goes by its name.

Invariants:

1. A topic (a service) is carried by exactly one relay at any time, for all its publishers.
2. What is carried stays where it is for as long as it can: a plan moves as few running monitors as possible, then as
   few topics and services that are carried now. Only then loads are evened out.
3. In one plan no relay both gives up and gets monitored topics: one that gets some has their monitors before it carries
   them, and one that gives some up keeps their monitors until it carries them no longer.
4. The allocation survives the death of control, as connections in the relays do.
"""

import json
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from appliance.specifications.specification_files import Checked

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
    losing: frozenset[int] = frozenset()
    """Relays that give up monitors, or topics and services that may have had some."""


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

    @property
    def resources(self) -> set[Resource]:
        """The topics and services that have a place of their own, not by their name."""
        return set(self._plan.resources)

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
        carried = set(carried)
        groups = groups_of(checked)
        homes = self._homes(groups, carried)
        plan = self._planned(groups, homes, carried)
        gaining = {plan.files[name] for name in plan.moved_files} | {move.target for move in plan.moves}
        if plan.losing & gaining:
            homes = self._one_way(groups, homes, carried)
            plan = self._planned(groups, homes, carried)
        return plan

    def _homes(self, groups: Sequence[Group], carried: Collection[Resource]) -> list[int]:
        """For each group the relay where it costs least."""
        homes: list[int] = []
        loads = [0] * self.relays
        for group in groups:
            costs = [
                (*self._cost(group, relay, carried), loads[relay], relay) for relay in range(self.relays)
            ]
            homes.append(min(costs)[-1])
            loads[homes[-1]] += group.specifications
        return homes

    def _one_way(
        self, groups: Sequence[Group], homes: Sequence[int], carried: Collection[Resource]
    ) -> list[int]:
        """The same, but all groups for which something moves are on one relay: nothing leaves it."""
        moving = [
            self._cost(group, home, carried) != (0, 0) for group, home in zip(groups, homes, strict=True)
        ]

        def cost(relay: int) -> tuple[int, int]:
            costs = [
                self._cost(group, relay, carried)
                for group, moves in zip(groups, moving, strict=True)
                if moves
            ]
            return sum(files for files, _ in costs), sum(resources for _, resources in costs)

        target = min(range(self.relays), key=cost)
        return [target if moves else home for moves, home in zip(moving, homes, strict=True)]

    def _planned(self, groups: Sequence[Group], homes: Sequence[int], carried: set[Resource]) -> Plan:
        """The plan with these groups on these relays."""
        before = self._plan
        files: dict[str, int] = {}
        resources: dict[Resource, int] = {}
        for group, relay in zip(groups, homes, strict=True):
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
        losing = {before.files[name] for name in moved}
        losing |= {move.source for move in moves if (move.kind, move.name) in before.resources}
        return Plan(files, resources, moves, moved, frozenset(losing))

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
            resource in carried and self._of(self._plan.resources, resource) != relay
            for resource in group.resources
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
        touched[file] |= {(TOPIC, topic) for topic in checked.topics[name]}
        touched[file] |= {(SERVICE, service) for service in checked.services[name]}
    for file, topics in checked.published_by.items():
        touched[file] |= {(TOPIC, topic) for topic in topics}
    counts = Counter(checked.monitors.values())
    groups = [
        Group(
            {file: counts[file] for file in files},
            frozenset(resource for file in files for resource in touched[file]),
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
