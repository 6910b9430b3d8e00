"""Assign topics, services and files of specifications to relay processes.

Files whose specifications share topics, services or variables, or publish on each other's topics, form a *group*,
which is on one relay with everything that it uses, so every message meets all its monitors there.

1. At any time, exactly one relay carries a topic or service, for all its publishers.
2. A plan moves as few running monitors as possible, then as few topics and services, and then balances loads.
3. In a plan, no relay both loses and gains monitored topics. A relay has monitors before and after it carries their
   topics.
4. The allocation survives the death of control, as do connections in the relays.
"""

import json
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from appliance.specifications.specification_files import CheckedSpecifications

TOPIC, SERVICE = "topic", "service"
Resource = tuple[str, str]
"""`TOPIC` or `SERVICE`, and a name."""


@dataclass(frozen=True, slots=True)
class FileGroup:
    """A group of files: the number of specifications in each, and the topics and services that they use."""

    files: Mapping[str, int]
    resources: frozenset[Resource]

    @property
    def specifications(self) -> int:
        return sum(self.files.values())


@dataclass(frozen=True, slots=True)
class Move:
    """A topic or service moves to another relay."""

    kind: str
    name: str
    source: int
    target: int


@dataclass(frozen=True, slots=True)
class AllocationPlan:
    """Which relay runs each file and each topic or service, and what has to move."""

    files: Mapping[str, int] = field(default_factory=dict)
    resources: Mapping[Resource, int] = field(default_factory=dict)
    moves: tuple[Move, ...] = ()
    moved_files: frozenset[str] = frozenset()
    losing: frozenset[int] = frozenset()
    """The relays that give up monitors, or topics and services that may have had some."""


class Allocation:
    """The present assignment; `save(text)` stores it."""

    def __init__(self, relays: int, save: Callable[[str], None] = lambda _text: None) -> None:
        self.relays = relays
        self._save = save
        self._plan = self._former = AllocationPlan()

    def of(self, kind: str, name: str) -> int:
        return self._of(self._plan.resources, (kind, name))

    def of_file(self, file: str) -> int:
        return self._plan.files.get(file, 0)

    @property
    def resources(self) -> set[Resource]:
        return set(self._plan.resources)

    def restore(self, text: str) -> bool:
        try:
            kept = json.loads(text)
            plan = AllocationPlan(
                {str(name): int(relay) for name, relay in kept["files"]},
                {(str(kind), str(name)): int(relay) for kind, name, relay in kept["resources"]},
            )
        except (ValueError, KeyError, TypeError):
            return False
        if kept["relays"] != self.relays:
            return False
        self._plan = plan
        return True

    def plan(self, checked: CheckedSpecifications, carried: Collection[Resource] = ()) -> AllocationPlan:
        carried = set(carried)
        groups = groups_of(checked)
        homes = self._homes(groups, carried)
        plan = self._planned(groups, homes, carried)
        gaining = {plan.files[name] for name in plan.moved_files} | {move.target for move in plan.moves}
        if plan.losing & gaining:
            homes = self._one_way(groups, homes, carried)
            plan = self._planned(groups, homes, carried)
        return plan

    def plan_back(self, former: CheckedSpecifications, carried: Collection[Resource]) -> AllocationPlan:
        """Return a plan with the files where they were before the present plan, with these specifications."""
        groups, files = groups_of(former), self._former.files
        return self._planned(groups, [files[min(group.files)] for group in groups], set(carried))

    def _homes(self, groups: Sequence[FileGroup], carried: Collection[Resource]) -> list[int]:
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
        self, groups: Sequence[FileGroup], homes: Sequence[int], carried: Collection[Resource]
    ) -> list[int]:
        """Move all groups that move to one relay, so that no group has to leave it."""
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

    def _planned(
        self, groups: Sequence[FileGroup], homes: Sequence[int], carried: set[Resource]
    ) -> AllocationPlan:
        before = self._plan
        files: dict[str, int] = {}
        resources: dict[Resource, int] = {}
        for group, relay in zip(groups, homes, strict=True):
            files.update(dict.fromkeys(group.files, relay))
            resources.update(dict.fromkeys(group.resources, relay))
        for resource in carried:  # resources without a specification stay on their relay
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
        return AllocationPlan(files, resources, moves, moved, frozenset(losing))

    def adopt(self, plan: AllocationPlan) -> None:
        self._former, self._plan = self._plan, plan
        kept = {
            "relays": self.relays,
            "files": sorted(plan.files.items()),
            "resources": sorted((*resource, relay) for resource, relay in plan.resources.items()),
        }
        self._save(json.dumps(kept))

    def _cost(self, group: FileGroup, relay: int, carried: Collection[Resource]) -> tuple[int, int]:
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


def groups_of(checked: CheckedSpecifications) -> list[FileGroup]:
    """Return the groups of files, largest first."""
    touched: dict[str, set[Resource]] = {file: set() for file in checked.monitors.values()}
    for name, file in checked.monitors.items():
        touched[file] |= {(TOPIC, topic) for topic in checked.topics[name]}
        touched[file] |= {(SERVICE, service) for service in checked.services[name]}
    for file, topics in checked.published_by.items():
        touched[file] |= {(TOPIC, topic) for topic in topics}
    counts = Counter(checked.monitors.values())
    groups = [
        FileGroup(
            {file: counts[file] for file in files},
            frozenset(resource for file in files for resource in touched[file]),
        )
        for files in _join(touched, checked)
    ]
    return sorted(groups, key=lambda group: (-group.specifications, sorted(group.files)))


def _join(touched: Mapping[str, Iterable[Resource]], checked: CheckedSpecifications) -> list[set[str]]:
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
    for names in checked.sharing:
        first, *others = (checked.monitors[name] for name in names)
        for other in others:
            join(first, other)
    return list({id(files): files for files in group.values()}.values())
