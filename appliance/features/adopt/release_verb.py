"""The command `rosrv release`."""

import asyncio
import contextlib
import ipaddress
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, cast

import msgspec
import structlog
import typer

from appliance.base.counted import counted
from appliance.base.user_errors import with_remedy
from appliance.channel.admin import StatusWanted
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.cli.connection.target import Appliance, speaks_here
from appliance.cli.output import say_json, usage_error
from appliance.cli.standing import (
    WITHIN,
    NotStandingError,
    longest_wait,
    wait_until_robot_stands,
)
from appliance.features.adopt.adopt_answers import GiveBackReport
from appliance.features.adopt.adopt_record import AdoptRecord, Phase, boot_id, load_record, save_record
from appliance.features.adopt.graph_side import AdoptedGraph
from appliance.features.adopt.machine_facts import MachineFacts
from appliance.features.adopt.machine_side import master_of, start_stand_in
from appliance.features.adopt.operator_orders import RELEASE, show_order
from appliance.features.adopt.places import call_node
from appliance.features.adopt.requests import AdoptStatus, ReleaseOrder
from appliance.features.adopt.robot_side import MASTER_PORT, WAITS, remove_drop_ins, running_settings
from appliance.features.adopt.takeover import AdoptError, AdoptOperation
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import restore
from appliance.master.reconcile.subscribers import Subscribers
from appliance.network import close_ports
from appliance.network.boot_hold import BootHold
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
from rosmop.tool.terminal import printable, say
from roswire.uris import NodeUri
from roswire.xmlrpc import Value

# Give a graph back without the appliance: after a crash, from the state that control stored.
#
# An operator orders this. The appliance never does it: otherwise a host that crashes the appliance would open the
# robot.

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
        with _open(state) as store:
            report = await _release(state, store)
        end_hold()
        return report
    except (AdoptError, StoreError) as error:
        raise NetworkError(str(error)) from None
    finally:
        lock.close()


async def _release(state: Path, store: StateStore) -> GiveBackReport:
    record, registry = _record(state), Registry()
    restore(registry, store)
    trail = cast(AuditTrail, _Log())
    port = port_of_master(state)
    links = {text for node in registry.all() if _is_link(text := str(node.host))}
    machine = DeadMachine(state, record, port, links)
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
    await store.until_settled()
    return report


def port_of_master(state: Path) -> int:
    """Return the port of RVMaster, and so of the robot's own master."""
    settings = running_settings(state)
    return MASTER_PORT if settings is None else settings.listen_address[1]


@contextlib.contextmanager
def _open(state: Path) -> Iterator[StateStore]:
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

    def __init__(self, state: Path, record: AdoptRecord, port: int, links: Iterable[str] = ()) -> None:
        self._state, self._record, self._port = state, record, port
        self._host, self._own = Namespace.own(), [_HERE, *links]

    async def __call__(self, work: str, /, **terms: object) -> Found:
        if work == "look":
            facts = MachineFacts(
                self._record, _HERE, _HERE, own=self._own, master=master_of(self._host, self._port)
            )
            return dict(msgspec.to_builtins(facts))
        if work == "stand in":
            Isolation(self._host, IsolationSettings(ports=(PortRange.one(self._port),))).clear()
            if master_of(self._host, self._port) is None:
                stand_in = start_stand_in(self._host, self._port, self._record)
                self._record = msgspec.structs.replace(self._record, stand_in=stand_in)
                return {"started": True}
        if work == "phase" and terms["phase"] is Phase.FREE:
            save_record(self._state, msgspec.structs.replace(self._record, wanted=False, phase=Phase.FREE))
        return {}


def _record(state: Path) -> AdoptRecord:
    try:
        return load_record(state)
    except NetworkError:
        # It cannot be read: the graph is given back whatever it said, to the master that runs.
        return AdoptRecord(phase=Phase.TAKEN, boot=boot_id())


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


_VERB = "rosrv release"
_STILL_CLOSED = (
    "the rules of `rosrv protect` stay in force, so other machines do not reach the topics and services of the robot's"
    " nodes: sudo rosrv protect --remove"
)


@speaks_here
def release(
    appliance: Appliance,
    *,
    dead: Annotated[
        bool,
        typer.Option(
            "--dead",
            help="If the appliance has crashed and stays off, give the graph back from its stored state",
        ),
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Release even if monitors are enabled and the robot may be moving"),
    ] = False,
    within: Annotated[float, longest_wait("until the robot stands still")] = WITHIN,
) -> None:
    """Give the graph of an adopted robot back to its own ROS master, without restarting a node. Needs root.

    The appliance runs on, but the robot's nodes no longer use it. While monitors are enabled, the command waits until
    the robot stands still, because guards end with the release. If the robot's own master no longer runs, another one
    is started.

    Example: rosrv release
    """
    state = appliance.state_here(_VERB)
    if os.geteuid() != 0:
        raise usage_error("the rules and sockets of this machine need root: run it with sudo", verb=_VERB)
    try:
        if dead:
            # A reader of standard output that has ended (head) must not end it between two steps.
            structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
            report = asyncio.run(release_dead(state))
        else:
            if not force:
                _stand(appliance, within)
            report = _order(appliance, state)
        remove_drop_ins()
    except NetworkError as error:
        typer.echo(f"{_VERB}: {error}", err=True)
        raise typer.Exit(1) from None
    with contextlib.suppress(NetworkError):  # without nft, nothing closes them
        if report.nodes and close_ports.is_applied():
            typer.echo(_STILL_CLOSED, err=True)
    if appliance.as_json:
        say_json(msgspec.to_builtins(report))
        return
    if not report.nodes:
        say("nothing is adopted: nodes that use this appliance go on using it")
        return
    if report.withheld:
        withheld = counted(report.withheld, "registration")
        text = (
            f"{_VERB}: {counted(report.nodes, 'node keeps its topics', 'nodes keep their topics')}, but {withheld}"
            f" and the parameters are not given back: {report.withheld_from}. Stop that master, start the robot's own,"
            " and restart the robot's nodes"
        )
        typer.echo(printable(text), err=True)
        raise typer.Exit(1)
    say(
        f"released in {report.seconds:g} s: {report.in_words}; {counted(report.given, 'registration')}"
        f" given back, {report.ended} ended"
    )
    if report.started:
        say("the robot had no master of its own, so one was started: rosrv-left-master")
    for name in report.failed:
        say(f"not told: {name} did not answer")
    if not dead:
        say("The appliance runs on without them: sudo systemctl stop rosrv, or rosrv adopt")


def _order(appliance: Appliance, state: Path) -> GiveBackReport:
    try:
        with show_order(state, RELEASE):
            answer = appliance.ask(ReleaseOrder())
    except NotRunningError as error:
        raise NetworkError(f"{error}. After a crash: rosrv release --dead") from None
    if not answer.ok:
        if answer.error.startswith(WAITS) and (record := load_record(state)).phase is Phase.FREE:
            save_record(state, msgspec.structs.replace(record, wanted=False))
            end_hold()
            return GiveBackReport()
        raise NetworkError(answer.error)
    return answer.unwrap()


def end_hold() -> None:
    """Let other machines reach the robot again, now and at the next boot. Raises `NetworkError`."""
    hold = BootHold(Namespace.own())
    try:
        hold.arm(None)
    except OSError as error:
        raise NetworkError(f"the boot hold stays: {with_remedy(error)}") from None
    hold.lift()


def _stand(appliance: Appliance, within: float) -> None:
    try:
        adopted = appliance.ask(AdoptStatus())
        if adopted.ok and adopted.unwrap().phase == "free":
            return
        answer = appliance.ask(StatusWanted())
    except NotRunningError:
        return
    if not answer.ok or not answer.unwrap().monitors.enabled:
        return
    assert isinstance(appliance.way, AdminSocket)  # noqa: S101  the verb is given on this machine
    try:
        say(asyncio.run(wait_until_robot_stands(appliance, appliance.way.state, within)))
    except NotStandingError as error:
        raise NetworkError(
            f"monitors are enabled, and {error}. Nothing was changed; --force releases anyway"
        ) from None
