"""Answer the requests about guards in control: their states, proposals, new guards and new values."""

import asyncio
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple, Protocol

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph
from appliance.channel.answers.monitor_answers import Replacement
from appliance.channel.messages import GivenValue
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.guards import requests as guard_requests
from appliance.features.guards.evidence import guard_digest
from appliance.features.guards.fitness import GuardFitness
from appliance.features.guards.guard_answers import (
    GuardList,
    GuardPlan,
    GuardRow,
    LastStop,
    LoadedSuggestion,
    ProofTest,
    Suggestions,
)
from appliance.features.guards.guard_facts import facts_of, preset_row, values_of
from appliance.features.guards.presets import (
    PRESETS,
    GuardError,
    Preset,
    below_the_standard,
    description_of,
    former_guard,
    is_former,
    keeps_state,
    loaded_values,
    preset_named,
    preset_of,
    text_of,
    topics_in,
    types_in,
    unknown_guard,
    with_values,
)
from appliance.features.guards.released import origin_of
from appliance.features.guards.robot_graph import RobotGraph
from appliance.features.guards.suggestions import advice, inside
from appliance.features.guards.upgrades import Upgrade, plan, same, upgrade_of
from appliance.features.guards.view import ActingGuard, BypassedGuard, GuardsState, OlderGuard
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.audit_trail import AuditTrail

# Say where a guard cannot help: the base is on another machine, or takes its commands past the appliance.
#
# 1. A cut between the appliance and the base ends the guard's stops too.
# 2. A process that can reach the base's own ports can give it other publishers. So each node that carries out a
# guarded
#    command is asked for its connections, one node at a time, and a publisher that the appliance did not give it is
#    reported if it is there twice in a row.

_PAUSE_SECONDS = 2.0
"""Between two questions, so that each of ten drivers is asked every 20 seconds."""
_MAX_UNANSWERED = 3


class GuardedDriver(NamedTuple):
    """A node that carries out a guarded command, and its host."""

    topic: str
    node: str
    host: str


class ConnectedNodes(Protocol):
    """The core's knowledge of nodes' machines and connections (`control/operators/node_connections.py`)."""

    def is_here(self, host: str) -> bool | None:
        """Return whether a host is the appliance's machine, or null if the appliance cannot know."""

    async def unknown_publishers(self, node: str, topic: str) -> list[str] | None:
        """Return the URIs of a node's publishers that the appliance did not give it, or null without an answer."""


class Placement:
    """Finds the drivers of guarded topics; `commands()` returns these topics. `report` takes each new bypass."""

    def __init__(
        self,
        commands: Callable[[], Iterable[str]],
        graph: Callable[[], Graph],
        connections: ConnectedNodes,
        report: Callable[[BypassedGuard], None],
    ) -> None:
        self._report = report
        self._commands, self._graph, self._connections = commands, graph, connections
        self.elsewhere: list[str] = []
        self.inside: list[str] = []
        self._suspected: dict[GuardedDriver, set[str]] = {}
        self._confirmed: dict[GuardedDriver, list[str]] = {}
        self._unanswered: dict[GuardedDriver, int] = {}

    @property
    def bypassed(self) -> list[BypassedGuard]:
        return [_bypass_of(driver, uris) for driver, uris in sorted(self._confirmed.items())]

    @property
    def unanswered(self) -> list[str]:
        """The nodes that do not say from whom they take a guarded command."""
        return sorted({driver.node for driver, times in self._unanswered.items() if times >= _MAX_UNANSWERED})

    async def watch(self) -> None:
        while True:
            for driver in self.look():
                await self.ask(driver)
                await asyncio.sleep(_PAUSE_SECONDS)
            await asyncio.sleep(_PAUSE_SECONDS)

    def look(self) -> list[GuardedDriver]:
        """Find the drivers, and return those to ask."""
        commands = {*self._commands()}
        drivers, self.inside = self._drivers(commands) if commands else ([], [])
        self.elsewhere = [*self._sentences(drivers)]
        for known in (self._suspected, self._confirmed, self._unanswered):
            for driver in known.keys() - {*drivers}:
                known.pop(driver)
        return drivers

    async def ask(self, driver: GuardedDriver) -> None:
        uris = await self._connections.unknown_publishers(driver.node, driver.topic)
        if uris is None:
            self._unanswered[driver] = self._unanswered.get(driver, 0) + 1
            return
        self._unanswered.pop(driver, None)
        again = [uri for uri in uris if uri in self._suspected.get(driver, ())]
        self._suspected[driver] = {*uris}
        if again:
            if driver not in self._confirmed:
                self._report(_bypass_of(driver, again))
            self._confirmed[driver] = again
        elif not uris:
            self._confirmed.pop(driver, None)

    def sentences(self, topic: str) -> list[str]:
        """Return a sentence for each way past a new guard: a cut to another machine, and a driver's own process."""
        drivers, within = self._drivers({topic})
        return [*self._sentences(drivers), *within]

    def _drivers(self, commands: set[str]) -> tuple[list[GuardedDriver], list[str]]:
        graph = self._graph()
        hosts = {node.name: node.host for node in graph.nodes}
        robots = RobotGraph(facts_of(graph), commands)
        guarded = [topic for topic in robots.topics if topic.name in commands]
        return [
            GuardedDriver(topic.name, node, hosts[node])
            for topic in guarded
            for node in sorted(robots.ends(topic)) if node in hosts
        ], [sentence for topic in guarded for sentence in inside(robots, topic)]  # fmt: skip

    def _sentences(self, drivers: Iterable[GuardedDriver]) -> Iterator[str]:
        for topic, host in dict.fromkeys((driver.topic, driver.host) for driver in drivers):
            here = self._connections.is_here(host)
            if here is None:
                yield (
                    f"{topic}: the base is on {host}: if that is another machine than this container's, a cut between"
                    " here and there is not guarded"
                )
            elif not here:
                yield f"{topic}: the base is on {host}: a cut between here and there is not guarded"


def _bypass_of(driver: GuardedDriver, uris: list[str]) -> BypassedGuard:
    return BypassedGuard(driver.topic, driver.node, driver.host, uris)


STOPPING_SECONDS = 2.0
"""A guard is stopping if it acted in these last seconds; relays report once a second."""
_LOOK_SECONDS = 0.5
_ACTS = ("drop", "change", "publish", "call")


def _written(value: bool | int | float | str) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


class GuardOrders:
    """Answers requests about guards; `graph()` returns the present graph."""

    def __init__(
        self,
        monitors: SpecificationManager,
        graph: Callable[[], Graph],
        connections: ConnectedNodes,
        trail: AuditTrail,
        fitness: GuardFitness,
        *,
        tests: Mapping[str, ProofTest],
    ) -> None:
        """`tests` are the last proof tests, by guard."""
        self._monitors, self._graph, self._trail = monitors, graph, trail
        self._fitness, self._tests = fitness, tests
        self.placement = Placement(self._guarded_commands, graph, connections, self._note_bypass)
        self._acts: dict[str, int] = {}
        self._acted_at: dict[str, float] = {}
        self._acting_since: dict[str, float] = {}
        self._digests: dict[str, str] = {}
        self._recorded = ""
        """The tag of the monitors whose guards are recorded."""

    def methods(self) -> tuple[RequestMethod[object], ...]:
        return (
            RequestMethod(guard_requests.GuardsWanted, self.guards, order=False),
            RequestMethod(guard_requests.GuardSuggestionsWanted, self.suggestions, order=False),
            RequestMethod(guard_requests.GuardNew, self.new, who=True),
            RequestMethod(guard_requests.GuardSet, self.set, who=True),
            RequestMethod(guard_requests.GuardUpgrade, self.upgrade, who=True),
            RequestMethod(guard_requests.GuardTry, self.plan, order=False, who=True),
        )

    async def watch(self) -> None:
        while True:
            self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self) -> None:
        guards = self._guards()
        self._acted_at = {name: at for name, at in self._acted_at.items() if name in guards}
        for name in guards:
            acts = self._acts_of(name)
            if acts > self._acts.get(name, acts):
                self._acted_at[name] = clock.now()
            self._acts[name] = acts
        self._acts = {name: acts for name, acts in self._acts.items() if name in guards}
        acting, now = [name for name in guards if self._state(name) == "stopping"], clock.wall()
        self._acting_since = {name: self._acting_since.get(name, now) for name in acting}
        self._record_loaded()
        self._fitness.look(guards)

    def _record_loaded(self) -> None:
        """Record the guards whose text or values are others than before, after any change; at the start: all."""
        if self._recorded == self._monitors.tag:
            return
        self._recorded = self._monitors.tag
        rows = [self._row(name, preset) for name, preset in self._guards().items()]
        for row in rows:
            if row.digest != self._digests.get(row.name):
                self._trail.happened(
                    "guard loaded",
                    f"{row.name} has the text and values with the digest {row.digest}"
                    f" ({row.preset} {row.version}, {row.origin})",
                    category="monitor",
                    resource=row.topics.get("command", ""),
                    monitor=row.name,
                    preset=row.preset,
                    version=row.version,
                    origin=row.origin,
                    digest=row.digest,
                    values=values_of(row.given) | row.loads,
                    below=row.below,
                    revision_of_specifications=self._monitors.revision,
                )
        self._digests = {row.name: row.digest for row in rows}

    def state(self) -> GuardsState | None:
        guards, place, former = self._guards(), self.placement, self._former()
        fitness = self._fitness
        if not guards and not former and fitness.heartbeat is None:
            return None
        switches = self._monitors.switches
        return GuardsState(
            len(guards),
            [ActingGuard(name, since, self._cause(name)) for name, since in self._acting_since.items()],
            place.elsewhere,
            place.bypassed,
            place.unanswered,
            {name: self._monitors.lasting(name) for name in guards
             if name not in switches.said and not switches.is_enabled(name)},
            [*self._older(guards)],
            former,
            dict(fitness.late),
            fitness.times,
            fitness.heartbeat,
        )  # fmt: skip

    def _older(self, guards: Mapping[str, Preset]) -> Iterator[OlderGuard]:
        for name, guard in guards.items():
            present = PRESETS[guard.name].version
            if guard.version < present and self._monitors.switches.is_enabled(name):
                edited = origin_of(guard.text) == "changed"
                yield OlderGuard(name, guard.name, guard.version, present, edited)

    def _note_bypass(self, guard: BypassedGuard) -> None:
        self._trail.happened(
            "guard bypassed",
            f"{guard.node} takes {guard.topic} from {', '.join(guard.publishers)}, past its guards",
            category="monitor",
            resource=guard.topic,
            node=guard.node,
            host=guard.host,
            publishers=guard.publishers,
        )

    async def guards(self, request: guard_requests.GuardsWanted) -> GuardList:
        rows = [self._row(name, preset) for name, preset in self._guards().items()]
        presets = [preset_row(preset) for preset in PRESETS.values()] if request.presets else []
        return GuardList(
            self._monitors.revision, self._monitors.tag, presets, rows,
            [*self._former().values(), *self.placement.elsewhere, *self.placement.inside],
        )  # fmt: skip

    async def suggestions(self, _request: guard_requests.GuardSuggestionsWanted) -> Suggestions:
        loaded = [
            LoadedSuggestion(name, preset.name, self._row(name, preset).topics, self._state(name))
            for name, preset in self._guards().items()
        ]
        return advice(facts_of(self._graph()), loaded, self._monitors.checked.monitors)

    async def new(self, request: guard_requests.GuardNew, who: str) -> Replacement:
        file, text = self._make(request)
        if self._monitors.sources.files.get(file) == text:
            return self._monitors.replacement(self._monitors.revision, loaded=[file]).in_lines()
        order = admin.MonitorLoad(
            {file: text}, note=description_of(text), expected=request.expected, confirm_within=request.confirm_within,
            shadow=request.shadow, hold=request.hold,
        )  # fmt: skip
        loaded = await self._monitors.load(order, who, enable=not request.shadow)
        self._record_loaded()
        done = loaded.in_lines()
        done.warnings.extend(self.placement.sentences(request.topics["command"]))
        return done

    async def set(self, request: guard_requests.GuardSet, who: str) -> GuardList:
        monitors, name = self._monitors, request.name
        text, changed, constants = self._change(name, request.values)
        given: dict[str, dict[str, GivenValue]] = {name: dict(constants)} if constants else {}
        if changed != text:  # one change of both, so that none of them is in force without the other
            order = admin.MonitorLoad(
                {monitors.checked.monitors[name]: changed}, note=description_of(changed), expected=request.expected,
                shadow=monitors.switches.in_shadow(name), hold=request.hold, given=given,
            )  # fmt: skip
            await monitors.load(order, who)
        elif constants:
            await monitors.give(admin.MonitorGive(name, dict(constants), request.expected), who)
        self._record_loaded()
        return await self.guards(guard_requests.GuardsWanted())

    async def upgrade(self, request: guard_requests.GuardUpgrade, who: str) -> Replacement:
        monitors, name = self._monitors, request.name
        if origin_of(self._guard(name)[1]) == "current":
            return monitors.replacement(monitors.revision).in_lines()
        new = self._upgrade(name, request.topics)
        order = admin.MonitorLoad(
            {monitors.checked.monitors[name]: new.text}, note=description_of(new.text), expected=request.expected,
            confirm_within=request.confirm_within, shadow=monitors.switches.in_shadow(name), hold=request.hold,
        )  # fmt: skip
        loaded = await monitors.load(order, who)
        self._record_loaded()
        return loaded.in_lines()

    async def plan(self, request: guard_requests.GuardTry, who: str) -> GuardPlan:
        monitors, name = self._monitors, request.name or request.preset
        changed: dict[str, list[str]] = {}
        kept: list[str] = []
        if request.preset:
            file, text = self._make(request)
            shadow = request.shadow or monitors.switches.starts_in_shadow
            off, topics, stops = False, topics_in(text), 0
            changed = {each: ["", value] for each, value in request.values.items()}
            kept = self.placement.sentences(request.topics["command"])
        else:
            present, text, _constants = self._change(name, request.values)
            if request.upgrade:
                new = self._upgrade(name, request.topics)
                text, kept = new.text, new.warnings
            file = "" if text == present else monitors.checked.monitors[name]
            row = self._row(name, self._guards()[name])
            shadow = monitors.switches.in_shadow(name) and not request.enforce
            off = not shadow and not request.enforce and not monitors.switches.is_enabled(name)
            topics, stops = row.topics, row.stops
            before = row.loads | {one.name: _written(one.value) for one in row.given if one.kind != "topic"}
            after = {
                each: self._guards()[name].parameter(each).check(to) for each, to in request.values.items()
            }
            changed = {each: [before[each], to] for each, to in after.items() if not same(before[each], to)}
            if request.upgrade:
                changed = {**new.changed}
        warnings, refused = await self._judge(request, file, text, who, shadow=shadow)
        begins = bool(file) and not (request.values and keeps_state(text, request.values))
        return GuardPlan(
            monitors.revision, monitors.tag, name, file, text if file else "", begins, shadow, changed, topics,
            stops, kept + warnings, refused, off,
        )  # fmt: skip

    async def _judge(
        self, request: guard_requests.GuardTry, file: str, text: str, who: str, *, shadow: bool
    ) -> tuple[list[str], list[str]]:
        warnings: list[str] = []
        try:
            if file:
                load = admin.MonitorLoad({file: text}, shadow=shadow, hold=request.hold)
                warnings += map(str, (await self._monitors.attempt(admin.MonitorTry(load), who)).warnings)
            if request.enforce:
                order = admin.MonitorShadow([request.name], False)
                warnings += self._monitors.judge_shadow(order)
        except SpecificationsRefusedError as error:
            return warnings, error.findings
        return warnings, []

    def _make(self, request: guard_requests.GuardNew | guard_requests.GuardTry) -> tuple[str, str]:
        try:
            if "command" not in request.topics:
                raise GuardError("topics has no `command`: name the topic to guard, such as /cmd_vel")
            name, graph = request.name or request.preset, facts_of(self._graph())
            preset = preset_named(request.preset)
            guard = plan(preset, name, request.topics, graph, request.values, request.types)
            shadow = request.shadow or self._monitors.switches.starts_in_shadow
            text = text_of(replace(guard, switch="shadow" if shadow else "on"))
            file = f"{name}.rv"
            present = self._monitors.sources.files.get(file)
            if present != text and (present is not None or name in self._monitors.checked.monitors):
                raise GuardError(
                    f"a monitor {name} is loaded: give another name (--name), or change it: rosrv guard set {name}"
                    " VALUE=…"
                )
        except GuardError as error:
            raise SenselessError(str(error)) from error
        return file, text

    def _upgrade(self, name: str, topics: Mapping[str, str]) -> Upgrade:
        preset, text = self._guard(name)
        try:
            in_force = {
                one.name: _written(one.value) for one in self._row(name, preset).given if one.kind != "topic"
            }
            return upgrade_of(text, in_force, facts_of(self._graph()), topics, self._monitors.lasting(name))
        except GuardError as error:
            raise SenselessError(str(error)) from error

    def _change(self, name: str, values: Mapping[str, str]) -> tuple[str, str, dict[str, str]]:
        preset, text = self._guard(name)
        try:
            checked = {each: preset.parameter(each).check(value) for each, value in values.items()}
            in_text = {each: value for each, value in checked.items() if preset.parameter(each).loads}
            changed = with_values(text, in_text)
        except GuardError as error:
            raise SenselessError(str(error)) from error
        return text, changed, {each: value for each, value in checked.items() if each not in in_text}

    def _guards(self) -> Mapping[str, Preset]:
        files = self._monitors.sources.files
        found = {
            name: preset_of(files.get(file, "")) for name, file in self._monitors.checked.monitors.items()
        }
        return {name: preset for name, preset in found.items() if preset is not None}

    def _former(self) -> dict[str, str]:
        """Return what to do about each monitor that was a guard before 0.4, by its name."""
        files = self._monitors.sources.files
        return {
            name: former_guard(name, file)
            for name, file in self._monitors.checked.monitors.items()
            if is_former(files.get(file, ""))
        }

    def row(self, name: str) -> GuardRow:
        """Return a guard. Raises `UnknownThingError`."""
        return self._row(name, self._guard(name)[0])

    def _guarded_commands(self) -> frozenset[str]:
        given = self._monitors.sources.topics
        return frozenset(
            (topics_in(guard.text) | given.get(name, {})).get("command", "")
            for name, guard in self._guards().items()
            if guard.name != "withhold"
        )

    def _guard(self, name: str) -> tuple[Preset, str]:
        guards = self._guards()
        if name not in guards:
            raise UnknownThingError(self._former().get(name) or unknown_guard(name, guards))
        return guards[name], self._monitors.sources.files[self._monitors.checked.monitors[name]]

    def _acts_of(self, name: str) -> int:
        """Return how often the guard acted, or would have acted in shadow mode."""
        before = "shadow " if self._monitors.switches.in_shadow(name) else ""
        return sum(self._monitors.records.counts[f"{before}{kind}", name] for kind in _ACTS)

    def _cause(self, name: str) -> str:
        """Return why a guard stops the robot now, or an empty text."""
        stops = self._monitors.records.stops
        return stops.last[name].present if stops.goes_on(name) else ""

    def _last_stop(self, name: str) -> LastStop | None:
        stops = self._monitors.records.stops
        stop = stops.last.get(name)
        if stop is None:
            return None
        since, last = (time / 1e9 for time in stop.span)
        until = None if stops.goes_on(name) else last
        return LastStop(
            since,
            until,
            stop.count,
            stop.present if until is None else stop.cause,
            stop.host,
            stop.node,
            stop.record,
            *stop.publisher,
        )

    def _state(self, name: str) -> str:
        monitors = self._monitors
        if name in monitors.rollout.held:
            return "holding"
        if monitors.switches.in_shadow(name):
            return "shadow"
        if not monitors.switches.is_enabled(name):
            return "off"
        if name in monitors.checked.unbuilt:
            return "broken"
        row = monitors.rollout.rows.get(name)
        if row is not None and row.withholds:
            return "withholding"
        acted = self._acted_at.get(name)
        return "free" if acted is None or clock.now() - acted > STOPPING_SECONDS else "stopping"

    def _row(self, name: str, preset: Preset) -> GuardRow:
        monitors = self._monitors
        file = monitors.checked.monitors[name]
        text = monitors.sources.files[file]
        given = monitors.givens.states(monitors.checked, name)
        return GuardRow(
            name=name,
            preset=preset.name,
            file=file,
            state=self._state(name),
            topics={one.name: str(one.value) for one in given if one.kind == "topic"},
            types=types_in(text),
            given=given,
            loads=loaded_values(text),
            stops=self._acts_of(name),
            why_held=monitors.rollout.why_held.get(name, ""),
            confirm_by=monitors.until(name, of=True),
            off_until=monitors.until(name),
            last_stop=self._last_stop(name),
            version=preset.version,
            origin=origin_of(text),
            below=below_the_standard(preset, values_of(given)),
            digest=guard_digest(PRESETS[preset.name], text, values_of(given)),
            afresh=monitors.afresh(name) or "absent",
            awaits=row.awaits if (row := monitors.rollout.rows.get(name)) is not None else "",
            times=self._fitness.times.get(name),
            tested=self._tests.get(name),
            error=monitors.checked.unbuilt.get(name, ""),
        )
