"""Adopt or release the graph, at the start and by orders, until it is as the adoption record says."""

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NoReturn

import msgspec
import structlog

from appliance.base import clock
from appliance.base.withdrawal import take_effect
from appliance.control.core import ControlPart, Core
from appliance.control.errors import SenselessError, UnavailableError
from appliance.control.links.supervisor_link import MachineWorkFailedError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.adopt.adopt_answers import AdoptState, GiveBackReport, TakeOverReport
from appliance.features.adopt.adopt_record import AdoptRecord, Phase
from appliance.features.adopt.graph_side import AdoptedGraph
from appliance.features.adopt.machine_facts import MachineFacts
from appliance.features.adopt.requests import AdoptOrder, AdoptStatus, ReleaseOrder
from appliance.features.adopt.takeover import AdoptError, AdoptOperation, LeftThere
from appliance.master.calls.call import VALUE, Caller
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterWrite
from appliance.master.graph.registry import Life
from appliance.policy.model import Address, address_of
from appliance.rpc.master_reader import Entry, MasterReader
from appliance.rpc.server import Peer
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.supervisor.machine_work import Found
from roswire.errors import PeerError
from roswire.names import ROSOUT
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

_SETTING = "adopt"
_AGAIN_SECONDS, _LOOK_SECONDS = 5.0, 60.0
_READY_SECONDS = 0.05
_NO_NETNS = "a graph is adopted only with `isolation: netns`, on the robot's own computer"
_PAIRED = "a graph is not adopted by one of two appliances"

log = structlog.get_logger()


class AdoptMemory(msgspec.Struct):
    """Keeps over a restart of control the keys of adopted nodes, and all that stays with the other master."""

    nodes: list[str] = []
    denied: list[tuple[Entry, str]] = []
    missing: dict[str, str] = {}
    parameters: set[str] = set()
    connections: dict[str, str] = {}


async def begin(core: Core) -> ControlPart:
    obstacle = _NO_NETNS if core.settings.isolation != "netns" else _PAIRED if core.role.paired else ""
    if obstacle:
        refused = RefusedAdoption(core, obstacle)
        return ControlPart(
            (
                RequestMethod(AdoptStatus, refused.refuse, order=False),
                RequestMethod(AdoptOrder, refused.refuse),
                RequestMethod(ReleaseOrder, refused.refuse),
            ),
            {"the look at an earlier adoption": refused.look} if obstacle is _PAIRED else {},
            refused.status_fields,
        )
    part = AdoptPart(core)
    core.links.before_end(part.before_end)
    core.links.after_removal(part.after_removal)
    return ControlPart(
        (
            RequestMethod(AdoptStatus, part.status, order=False),
            RequestMethod(AdoptOrder, part.adopt),
            RequestMethod(ReleaseOrder, part.release, full_disk=True),
        ),
        {"the adoption of the robot's graph": part.run},
        part.status_fields,
    )


class RefusedAdoption:
    """Answers where the appliance cannot take a graph over; a graph that is still wanted is an alarm."""

    def __init__(self, core: Core, reason: str) -> None:
        self._core, self._reason, self._record = core, reason, AdoptRecord()

    async def refuse(self, _request: object) -> NoReturn:
        raise SenselessError(self._reason)

    async def look(self) -> None:
        with suppress(MachineWorkFailedError):  # without the robot's side, nothing was adopted
            found = await self._core.links.machine_work("adopt", "look", ports=[], names=[])
            self._record = msgspec.convert(found, MachineFacts, strict=False).record

    def status_fields(self) -> Mapping[str, object]:
        if not self._record.wanted:
            return {}
        obstacle = f"{self._reason}: stop it, and run `rosrv release --dead`"
        return {"adopt": _state_of(self._record, present=False, obstacle=obstacle)}


def _state_of(record: AdoptRecord, **more: Any) -> AdoptState:
    master = f"{record.program} ({record.unit or f'user {record.user}'})" if record.program else ""
    given: dict[str, Any] = {"nodes": 0, "not_started": 0, "denied": {}, "missing": {}, **more}
    return AdoptState(record.phase.value, record.wanted, record.since_utc, master, **given)


class AdoptPart:
    """The adoption, one operation at a time."""

    def __init__(self, core: Core) -> None:
        self._core, self._registrar = core, core.graph.registrar
        registrar = self._registrar
        self._graph = AdoptedGraph(
            registrar.registry, registrar.graph, registrar.subscribers, core.trail, self._order, registrar.flush,
            frozenset({ROSOUT, core.settings.publish_as}),
        )  # fmt: skip
        self._parameters = ParameterOrders(
            registrar.parameters, lambda: self._facts.link if self._facts else "127.0.0.1"
        )
        self._operation = AdoptOperation(
            self._machine,
            self._reader,
            self._graph,
            self._parameters,
            waiting=lambda: registrar.subscribers.delivery.waiting,
            silence=registrar.silence,
            speak=registrar.speak,
            passed=self._on_step,
            stored=self._stored,
        )
        self._one = asyncio.Lock()
        self._facts: MachineFacts | None = None
        self._obstacle = ""
        self._settled = False
        self._removed = asyncio.Event()

    # --- at the start, and while the appliance runs ---

    async def run(self) -> None:
        await self._registrar.ready()
        self._remember()
        while not self._core.relay.ready():
            await asyncio.sleep(_READY_SECONDS)
        while True:
            async with self._one:
                await self._settle()
            with suppress(TimeoutError):
                async with asyncio.timeout(_AGAIN_SECONDS if self._obstacle else _LOOK_SECONDS):
                    await self._removed.wait()
                    self._removed.clear()
                    self._settled = False

    def after_removal(self) -> None:
        """Take the graph over once more: other machines could reach the robot's own master."""
        self._removed.set()

    async def _settle(self) -> None:
        """Bring the graph to what the record wants; note the obstacle if that fails."""
        try:
            facts = self._facts = await self._operation.facts()
            report = await self._operation.settle(facts, settled=self._settled)
            if report is None:
                self._obstacle = ""
                return
            if isinstance(report, TakeOverReport):
                self._taken(report)
            else:
                self._given()
        except AdoptError as error:
            self._note_obstacle(str(error))
        else:
            self._obstacle = ""
            with suppress(AdoptError):
                self._facts = await self._operation.facts()

    def _note_obstacle(self, reason: str) -> None:
        if reason != self._obstacle:
            self._obstacle = reason
            self._core.trail.happened("adoption failed", reason)

    def _taken(self, report: TakeOverReport) -> None:
        self._settled = True
        self._save()
        log.info("the robot's graph is adopted", nodes=report.nodes, seconds=report.seconds)

    async def _give(self) -> GiveBackReport:
        report = await self._operation.give()
        self._given()
        return report

    def _given(self) -> None:
        self._settled = False
        self._save()

    async def before_end(self) -> None:
        """Give the graph back before an ordered end; the record still wants it, so the next start takes it again."""
        self._operation.end()
        async with self._one:
            try:
                facts = await self._operation.facts()
                if facts.record.phase is not Phase.FREE and (report := await self._give()).withheld:
                    log.error("the graph is only partly given back", reason=report.withheld_from)
            except AdoptError as error:
                log.error("the graph is not given back", reason=str(error))

    # --- orders ---

    async def adopt(self, _request: AdoptOrder) -> TakeOverReport:
        self._core.store.database.require_room()  # without a record nothing is granted
        async with self._one:
            take_effect()
            try:
                report = await self._operation.adopt()
            except AdoptError as error:
                raise UnavailableError(str(error)) from None
            self._taken(report)
            self._obstacle = ""
            return report

    async def release(self, _request: ReleaseOrder) -> GiveBackReport:
        async with self._one:
            take_effect()
            try:
                report = await self._operation.release()
                self._given()
                return report
            except AdoptError as error:
                raise UnavailableError(
                    f"{error}. The release is tried again while the appliance runs"
                ) from None

    async def status(self, _request: AdoptStatus) -> AdoptState:
        async with self._one:
            try:
                self._facts = await self._operation.facts()
            except AdoptError as error:
                raise UnavailableError(str(error)) from None
        return self._state(self._facts)

    def status_fields(self) -> Mapping[str, object]:
        if self._facts is None or not (
            self._facts.record.wanted or self._facts.record.phase is not Phase.FREE
        ):
            return {}
        return {"adopt": self._state(self._facts)}

    def _state(self, facts: MachineFacts) -> AdoptState:
        unasked = self._graph.subscribers.unasked
        return _state_of(
            facts.record,
            present=facts.master is not None,
            obstacle=self._obstacle or facts.foreign_master,
            nodes=len(self._graph.adopted_nodes()),
            not_started=sum(node.life is Life.LIVE for node in unasked),
            denied={" ".join(entry): why for entry, why in sorted(self._graph.denied.items())},
            missing=self._operation.left.nodes,
            not_cut=self._operation.left.not_cut,
        )

    # --- what the operation uses ---

    async def _machine(self, work: str, /, **terms: object) -> Found:
        try:
            return await self._core.links.machine_work("adopt", work, **terms)
        except MachineWorkFailedError as error:
            raise AdoptError(str(error)) from None

    def _reader(self, facts: MachineFacts) -> MasterReader:
        _host, port = self._core.settings.listen_address
        return MasterReader(NodeUri("http", facts.link, port, "/"))

    async def _order(self, host: Address, method: str, /, *params: Value) -> list[Value]:
        local = self._facts.appliance if self._facts is not None else str(host)
        answer = await self._registrar.call(host, local, method, params)
        return answer if isinstance(answer, list) else [0, "no answer", 0]

    async def _on_step(self, step: str) -> None:
        log.info("adoption", step=step)
        self._save()

    async def _stored(self) -> bool:
        try:
            await self._core.store.until_settled()
        except StoreError as error:
            log.warning("subscribers stay registered at the robot's own master", reason=str(error))
            return False
        return True

    # --- after a restart of control ---

    def _remember(self) -> None:
        """Restore what an earlier control knew, now that the registry is restored."""
        memory = _memory(self._core.store)
        self._operation.left = LeftThere(memory.missing, memory.parameters, memory.connections)
        self._graph.denied.update(memory.denied)
        registry = self._registrar.registry
        self._graph.subscribers.unasked.update(filter(None, map(registry.by_key, memory.nodes)))

    def _save(self) -> None:
        memory = AdoptMemory(
            sorted(node.key for node in self._graph.subscribers.unasked),
            list(self._graph.denied.items()),
            self._operation.left.nodes,
            self._operation.left.parameters,
            self._operation.left.connections,
        )
        self._core.store.save_setting(_SETTING, msgspec.json.encode(memory).decode())


class ParameterOrders:
    """RVMaster's parameters for the operation; those of the robot are charged to the robot's host."""

    def __init__(self, calls: ParameterCalls, link: Callable[[], str]) -> None:
        self._calls, self._link = calls, link

    def tree(self) -> Mapping[str, Value]:
        return self._calls.mirror.tree

    async def take(self, values: Mapping[str, Value]) -> dict[str, str]:
        """See `ParameterSide`. Any host may have written there, and its `{"": …}` would become the whole tree here."""
        host = address_of(self._link())
        caller = Caller(Peer(host, str(host), str(host)), "/rosrv", clock.now_ns())
        left, writes = dict[str, str](), dict[str, ParameterWrite]()
        for name, value in values.items():
            try:
                VALUE.canonicalise({name: "" if value is None else value}, "")
            except PeerError as error:
                left[name] = str(error)
            else:
                if "/" in name:
                    left[name] = "a plain master finds no parameter of this name"
                else:
                    writes[name] = ParameterWrite(caller, f"/{name}", value)
        outcomes = await self._calls.write([*writes.values()])
        failed = {
            name: str(outcome)
            for name, outcome in zip(writes, outcomes, strict=True)
            if isinstance(outcome, Exception)
        }
        return left | failed


def _memory(store: StateStore) -> AdoptMemory:
    try:
        return msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=AdoptMemory)
    except ValueError:
        return AdoptMemory()
