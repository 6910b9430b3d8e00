"""Give a graph back without the appliance: after a crash, from the state that control stored.

An operator orders this. The appliance never does it: otherwise a host that crashes the appliance would open the robot.
"""

import contextlib
import ipaddress
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import msgspec
import structlog

from appliance.features.adopt.adopt_answers import GiveBackReport
from appliance.features.adopt.adopt_record import FILE, AdoptRecord, Phase, load_record, save_record
from appliance.features.adopt.graph_side import AdoptedGraph
from appliance.features.adopt.machine_facts import MachineFacts
from appliance.features.adopt.machine_side import master_of, start_stand_in
from appliance.features.adopt.places import call_node
from appliance.features.adopt.robot_side import MASTER_PORT, running_settings
from appliance.features.adopt.takeover import AdoptError, AdoptOperation
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import restore
from appliance.master.reconcile.subscribers import Subscribers
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import Isolation, IsolationSettings
from appliance.network.namespaces import Namespace, NetworkError
from appliance.policy.model import Address
from appliance.rpc.master_reader import MasterReader
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.supervisor.errors import StartError
from appliance.supervisor.machine_work import Found
from appliance.supervisor.state_directory import StateDirectory
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

_HERE = "127.0.0.1"
_LINKS = ipaddress.IPv4Network(
    "10.111.0.0/16"
)  # of the appliance; the robot's nodes are known by its addresses

log = structlog.get_logger()


async def release_dead(state: Path) -> GiveBackReport:
    """Give the graph back. Raises `NetworkError`, for example while an appliance runs."""
    try:
        lock = StateDirectory(state)
    except StartError as error:
        raise NetworkError(str(error)) from None
    try:
        with _opened(state) as store:
            return await _release(state, store)
    except (AdoptError, StoreError) as error:
        raise NetworkError(str(error)) from None
    finally:
        lock.close()


async def _release(state: Path, store: StateStore) -> GiveBackReport:
    record, registry = _record(state), Registry()
    restore(registry, store)
    trail = cast(AuditTrail, _Log())
    port = port_of_master(state)
    machine = DeadMachine(state, record, port)
    graph = AdoptedGraph(
        registry, RosGraph(registry, Grants(lambda _row: None, set), trail), cast(Subscribers, _NoSubscribers()), trail,
        _no_order, flush=lambda: None,
    )  # fmt: skip
    keys = [node.key for node in graph.nodes()]
    if record.phase is Phase.FREE:
        save_record(state, msgspec.structs.replace(record, wanted=False))
        return GiveBackReport()
    operation = AdoptOperation(
        machine, lambda _facts: MasterReader(NodeUri("http", _HERE, port, "/")), graph,
        _StoredParameters(store.load_parameters()), waiting=lambda: 0, silence=lambda: None, speak=lambda: None,
        call=_call, forwards=False,
    )  # fmt: skip
    report = await operation.give()
    with store.database.together():
        for key in keys:
            store.forget_incarnation(key)
    await store.settled()
    return report


def port_of_master(state: Path) -> int:
    """Return the port of RVMaster, and so of the robot's own master."""
    settings = running_settings(state)
    return MASTER_PORT if settings is None else settings.listen_address[1]


@contextlib.contextmanager
def _opened(state: Path) -> Iterator[StateStore]:
    """Open control's state as its owner, so that no file of root is left in it."""
    folder = state / "control"
    try:
        owner = folder.stat()
    except OSError as error:
        raise NetworkError(
            f"{folder} cannot be read: {error.strerror}; give the appliance's state directory with --state"
        ) from None
    user, group = os.geteuid(), os.getegid()
    os.setegid(owner.st_gid)
    os.seteuid(owner.st_uid)
    try:
        store = StateStore(folder, failed=lambda reason: log.error("state is not written", reason=reason))
    finally:
        os.seteuid(user)
        os.setegid(group)
    try:
        yield store
    finally:
        store.close()


class DeadMachine:
    """Does the supervisor's work in its absence: see `machine_side.py`."""

    def __init__(self, state: Path, record: AdoptRecord, port: int) -> None:
        self._state, self._record, self._port = state, record, port
        self._host = Namespace.own()

    async def __call__(self, work: str, /, **terms: object) -> Found:
        if work == "look":
            facts = MachineFacts(
                self._record, _HERE, _HERE, own=[_HERE], master=master_of(self._host, self._port)
            )
            return dict(msgspec.to_builtins(facts))
        if work == "stand in":
            Isolation(self._host, IsolationSettings(ports=(PortRange.one(self._port),))).clear()
            if master_of(self._host, self._port) is None:
                start_stand_in(self._host, self._port, self._record)
                return {"started": True}
        if work == "phase" and terms["phase"] is Phase.FREE:
            save_record(self._state, msgspec.structs.replace(self._record, wanted=False, phase=Phase.FREE))
        return {}


def _record(state: Path) -> AdoptRecord:
    try:
        return load_record(state)
    except NetworkError:
        (state / FILE).unlink(missing_ok=True)  # it cannot be read: the graph is given back whatever it said
        return load_record(state)


async def _call(uri: NodeUri, method: str, /, *params: Value) -> Value:
    host = _HERE if _is_link(uri.host) else uri.host
    return await call_node(NodeUri(uri.scheme, host, uri.port, uri.path), method, *params)


def _is_link(host: str) -> bool:
    address = ipaddress.ip_address(host)
    return address.version == 4 and address in _LINKS


async def _no_order(_host: Address, method: str, /, *_params: Value) -> list[Value]:
    raise AdoptError(f"{method}: no appliance runs")


class _StoredParameters:
    def __init__(self, tree: Mapping[str, Value]) -> None:
        self._tree = tree

    def tree(self) -> Mapping[str, Value]:
        return self._tree

    async def take(self, _values: Mapping[str, Value]) -> dict[str, str]:
        raise AdoptError("no appliance runs")


class _NoSubscribers:
    def __init__(self) -> None:
        self.unasked: set[object] = set()


class _Log:
    """Takes the place of the audit log, which only control writes."""

    def happened(self, event: str, reason: str, **detail: object) -> str:
        log.info(event, reason=reason, **detail)
        return ""
