"""Build the part of control for guards."""

import asyncio
import contextlib
import re
from collections.abc import Callable, Sequence

import structlog

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph
from appliance.channel.answers.status import ProcessInfo
from appliance.channel.messages import MonitorEvent, OwnHeaderStated
from appliance.control.core import ControlPart, Core
from appliance.control.errors import SenselessError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.guards.driver_outcomes import sentence_of
from appliance.features.guards.fitness import GuardFitness
from appliance.features.guards.guard_answers import DriverCheck
from appliance.features.guards.guard_facts import facts_of
from appliance.features.guards.guard_orders import GuardOrders
from appliance.features.guards.presets import DRIVER_CHECK, GuardError, description_of, text_of
from appliance.features.guards.proof_tests import ProofTests, kept_tests
from appliance.features.guards.requests import DriverCheckBegin, DriverCheckWanted
from appliance.features.guards.upgrades import plan
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

# Measure whether a robot's own driver stops its base when commands end.
#
# 1. A monitor withholds only motions, once, and at most for the given time, whatever happens to control. A stop by a
#    guard, an operator or a node passes, and ends the check.
# 2. Control removes the monitor after the monitor's line in the log, when a relay is replaced, when the client no
#    longer polls, and when control starts. If all of this fails, the load is rolled back as unconfirmed.

NAME = DRIVER_CHECK.name
_FILE = f"{NAME}.rv"
_LINE = re.compile(r"driver check: (?P<outcome>\w+) after (?P<seconds>[\d.]+) s")
_LOOK_SECONDS = 0.1
_ANSWER_SECONDS = 1.0
_ASKED_SECONDS = 3.0
_FURTHER_SECONDS = 10.0
"""The additional time to wait for the monitor's line. If it does not come, the relay is not running the monitor."""
_LIMIT_SECONDS = 60.0
_log = structlog.get_logger()


class DriverChecks:
    """Begins one check at a time, and ends it."""

    def __init__(
        self,
        monitors: SpecificationManager,
        trail: AuditTrail,
        graph: Callable[[], Graph],
        processes: Callable[[], Sequence[ProcessInfo]],
    ) -> None:
        self._monitors, self._trail, self._graph, self._processes = monitors, trail, graph, processes
        self._check = DriverCheck()
        self._who = ""
        self._asked_at = self._until = 0.0
        self._relays: list[int] = []
        self._changing = asyncio.Lock()
        self._ended = asyncio.Event()

    def methods(self) -> tuple[RequestMethod[object], ...]:
        return (
            RequestMethod(DriverCheckBegin, self.begin, who=True),
            RequestMethod(DriverCheckWanted, self.check_drivers, order=False),
        )

    async def begin(self, request: DriverCheckBegin, who: str) -> DriverCheck:
        async with self._changing:
            return await self._begin(request, who)

    async def _begin(self, request: DriverCheckBegin, who: str) -> DriverCheck:
        monitors = self._monitors
        if NAME in monitors.checked.monitors:
            raise SenselessError("a driver is being checked: try again when that check has ended")
        if monitors.confirm_by is not None:  # it would get the time limit of the check
            raise SenselessError("specifications wait for rosrv monitor confirm: confirm them, or wait")
        text, seconds = self._text(request), request.patience + request.seconds
        order = admin.MonitorLoad(
            {_FILE: text}, note=description_of(text), confirm_within=seconds + _LIMIT_SECONDS
        )  # fmt: skip
        before, relays = self._check, self._pids()
        self._check, self._who = DriverCheck(request.command, request.by), who
        self._ended.clear()
        try:
            await monitors.load(order, who, enable=True)
        except BaseException:
            self._check = before
            raise
        monitors.records.told.append(self._on_report)
        self._asked_at, self._until = clock.now(), clock.now() + seconds + _FURTHER_SECONDS
        self._relays = relays
        if not monitors.switches.is_enabled(NAME):
            self._end("interrupted", None, "a new monitor is in shadow mode here (--enable shadow)")
        return self._check

    async def check_drivers(self, _request: DriverCheckWanted) -> DriverCheck:
        self._asked_at = clock.now()
        if self._under_way():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_ANSWER_SECONDS):
                    await self._ended.wait()
        if not self._under_way():  # the next order of the client finds the monitor removed
            async with self._changing:
                await self.look()
        return self._check

    async def watch(self) -> None:
        while True:
            async with self._changing:
                await self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    async def look(self) -> None:
        if NAME not in self._monitors.checked.monitors:
            if self._under_way():
                self._end("interrupted", None, "its monitor was removed")
            return
        if self._under_way():
            why = self._why_over()
            if why:
                self._end("interrupted", None, why)
        if not self._under_way():
            await self._remove()

    def _under_way(self) -> bool:
        return bool(self._check.command) and not self._check.outcome

    def _why_over(self) -> str:
        if clock.now() - self._asked_at > _ASKED_SECONDS:
            return "its client no longer asks for the outcome"
        if self._pids() != self._relays:
            return "a relay process was replaced"
        return "the relay does not report" if clock.now() > self._until else ""

    async def _remove(self) -> None:
        try:
            monitors, request = self._monitors, admin.MonitorRemove([_FILE])
            # A change during the check has its time limit, or one of its own. Control may have restarted.
            settled = monitors.in_force.note == description_of(monitors.sources.files[_FILE])
            await monitors.remove(request, self._who or NAME, settled=settled)
        except (SpecificationsRefusedError, StoreError) as error:
            _log.warning("the monitor of a driver check is not removed yet", error=str(error))
            await asyncio.sleep(1)

    def _on_report(self, event: MonitorEvent) -> None:
        match = _LINE.search(event.text) if (event.kind, event.monitor) == ("log", NAME) else None
        if match and self._under_way():
            self._end(match["outcome"], float(match["seconds"]))

    def _end(self, outcome: str, seconds: float | None, why: str = "") -> None:
        self._ended.set()
        self._monitors.records.told.remove(self._on_report)
        check, text = self._check, sentence_of(outcome, seconds, why)
        self._check = DriverCheck(check.command, check.by, outcome, seconds, text)
        self._trail.happened(
            "driver checked",
            f"{check.command}: {text}",
            category="monitor",
            resource=check.command,
            who=self._who,
            by=check.by,
            outcome=outcome,
            seconds=seconds,
        )

    def _pids(self) -> list[int]:
        return [process.pid for process in self._processes() if process.role.startswith("relay")]

    def _text(self, request: DriverCheckBegin) -> str:
        values = {"longest": f"{request.seconds:g}", "patience": f"{request.patience:g}"}
        topics = {"command": request.command, "by": request.by}
        try:
            text = text_of(plan(DRIVER_CHECK, NAME, topics, facts_of(self._graph()), values, {}))
        except GuardError as error:
            raise SenselessError(str(error)) from error
        return text + "".join(f"\norder {name} < {NAME};" for name in self._monitors.checked.monitors) + "\n"


_BOOL = ("std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a", "bool data\n")
"""The type of the heartbeat's topic, its md5sum and its definition."""


async def begin(core: Core) -> ControlPart:
    relay = core.settings.relay
    fitness = GuardFitness(core.specifications, relay, core.settings.relays, core.trail, core.store)
    if relay.heartbeat:
        core.relay.publish_only("guards", [OwnHeaderStated(relay.heartbeat, *_BOOL, latching=False)])
    tests = kept_tests(core.store)
    orders = GuardOrders(
        core.specifications, core.graph.present, core.graph.connections, core.trail, fitness, tests=tests
    )
    proofs = ProofTests(
        core.specifications,
        orders,
        tests,
        graph=core.graph,
        relay=core.relay,
        trail=core.trail,
        store=core.store,
    )
    checks = DriverChecks(core.specifications, core.trail, core.graph.present, core.links.processes)

    async def save() -> None:
        fitness.save()

    core.links.before_end(save)
    return ControlPart(
        (*orders.methods(), *proofs.methods(), *checks.methods()),
        {
            "the guards": orders.watch,
            "the place of guards": orders.placement.watch,
            "the check of a driver": checks.watch,
        },
        lambda: {"guards": orders.state()},
    )
