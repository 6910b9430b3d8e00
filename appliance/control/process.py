"""Run the control process: start its parts, serve until the supervisor stops the process, end the parts.

At its start, control takes over the listening sockets of an earlier control, opens the log and the store, brings the
policy into force, restores the registry, serves the listeners, registers all nodes with the ROS master in the first
reconcile round, and then sends `Ready`.
"""

import asyncio
import ctypes
import gc
import resource
import socket
import sys
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from pathlib import Path

import structlog
import uvloop

from appliance import __version__
from appliance.base.actors import DISK
from appliance.base.background import run_always
from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.admin import PolicyReload
from appliance.channel.answers.status import ProcessInfo
from appliance.channel.channel import Channel
from appliance.configuration.settings import Settings, load_resolved
from appliance.control.assembly.active_role import STATE_ERRORS, ActiveRole
from appliance.control.assembly.policies import RevisionChangedError
from appliance.control.assembly.robot import master_address
from appliance.control.control import INNER, OWN, RVMASTER, Control
from appliance.control.errors import PolicyRefusedError
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.operators.admin_socket import AdminServer
from appliance.control.start_gate import StartGate
from appliance.features.table import start_gate
from appliance.hosts.host_table import HostRefusedError
from appliance.master.endpoints.node_ports import NoPortError
from appliance.master.graph.registry import Kind
from appliance.master.reconcile.sinks import restore_nodes
from appliance.specifications.allocation import TOPIC
from appliance.specifications.compiled_store import CompiledStore
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import node_uri

# Handle the messages of the supervisor while control serves.

_RELAY_BACKLOG = 128 << 20  # bytes; changes of the graph use half of it


def record_death(trail: AuditTrail, death: messages.ProcessDied) -> None:
    trail.happened(
        "process died",
        f"{death.role}: {death.reason}",
        resource=death.role,
        index=death.index,
        pid=death.pid,
        end=death.end,
        lived=round(death.lived, 3),
        restarts=death.restarts,
    )


def record_removal(trail: AuditTrail, message: messages.RulesRestored) -> None:
    span = f"{'' if message.reported else 'at most '}{message.seconds:g} s"
    trail.happened(
        "firewall restored",
        f"{message.by or 'another program'} removed {counted(len(message.rules), 'rule')} of the firewall, now in"
        f" force again, after {span}; {counted(message.connections, 'connection')} of that time ended",
        seconds=message.seconds,
        by=message.by or None,
        rules=message.rules,
        connections=message.connections,
    )


class SupervisorMessages:
    """Passes the supervisor's links and reports to the parts of control."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self._tasks: set[asyncio.Task[None]] = set()
        self._one_reload = asyncio.Lock()
        self._failing: frozenset[str] = frozenset()  # the roles of processes that keep ending

    def heard(self, message: object, descriptors: tuple[int, ...]) -> None:  # noqa: PLR0912  a case for each message
        match message:
            case messages.LinkOpened(role, index):
                self._link(role, index, socket.socket(fileno=descriptors[0]))
            case messages.ProcessesChanged(processes):
                self._note_failing(processes)
                self._control.reconciler.wake()
            case messages.ProcessDied():
                record_death(self._control.trail, message)
            case messages.PolicyReloadRequested():
                self._spawn(self._reload())
            case messages.EndAnnounced():
                self._spawn(self._agree_to_end())
            case messages.Announced():
                self._control.tokens.first_token_shown()
            case messages.ClockRead(synchronised):
                self._control.clock.synchronisation_reported(synchronised)
            case messages.MachineAddresses(addresses):
                _log.info("addresses of the robot's machine", addresses=addresses)
                self._control.addresses.forget_routes()
                self._control.policies.hosts_changed()
            case messages.RulesRestored():
                record_removal(self._control.trail, message)
                for work in self._control.lifeline.surroundings.after_removal:
                    work()
            case messages.ProbeFailed(reason):
                self._control.listener_limits.probed(reason)
            case messages.ProbePassed():
                self._control.listener_limits.probed("")
            case _:
                _log.error(
                    "the supervisor sent a message that is not for control", message=type(message).__name__
                )

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # keep a reference until the task is done
        task.add_done_callback(self._tasks.discard)

    async def _agree_to_end(self) -> None:
        try:
            await self._control.lifeline.finish()
        finally:
            self._control.lifeline.say(messages.EndAgreed())

    def _note_failing(self, processes: list[ProcessInfo]) -> None:
        failing = {process.role: process for process in processes if process.failing}
        for role in failing.keys() - self._failing:
            process = failing[role]
            self._control.trail.happened(
                "process failing",
                f"{role}: {process.failing}",
                resource=role,
                restarts=process.restarts,
                output=process.output,
            )
        self._failing = frozenset(failing)

    def _link(self, role: str, index: int, sock: socket.socket) -> None:
        match role:
            case "relay":
                self._relay_link(index, Channel(sock, messages.RelayLink, limit=_RELAY_BACKLOG))
            case "signer":
                self._control.signing.attach(Channel(sock, messages.SignerLink))
            case "api":
                self._control.rest.attach(self._control.lifeline.api_channel(sock.detach()))
            case "charon":
                self._control.hosts.tunnels.attach(Channel(sock, messages.TunnelLink))
            case _:
                self._feature_link(role, index, sock)

    def _feature_link(self, role: str, index: int, sock: socket.socket) -> None:
        attached = self._control.core.links.of(role, index)
        if attached is None:
            _log.error("a link leads to a process unknown to control", role=role)
            sock.close()
            return
        link, accepted, longest = attached
        link.attach(Channel(sock, accepted, longest=longest))

    def _relay_link(self, index: int, channel: Channel) -> None:
        relay, subscribers = self._control.relay, self._control.subscribers
        relay.attach(index, channel)

        def carried(topic: str) -> bool:
            return relay.allocation.of(TOPIC, topic) == index

        if self._control.role.took_over:
            # Every connection ended, and roscpp may have given up: subscribers drop all publishers first.
            for kind, topic, _holders in list(self._control.registry.resources()):
                if kind is Kind.SUBSCRIPTION and carried(topic):
                    subscribers.renew_all(topic)
        subscribers.remind_all(carried)
        self._control.reminders.begin()

    async def _reload(self) -> None:
        async with self._one_reload:
            try:
                await self._reload_policy()
            except PolicyRefusedError as error:
                _log.error(
                    "the policy was rejected, the previous one stays in force", findings=error.findings
                )
            except StoreError as error:
                _log.error("the policy is in force and not stored", reason=str(error))
            try:
                await self._control.hosts.enrolment.read_again(DISK)
            except HostRefusedError as error:
                _log.error("hosts.yaml was rejected", reason=str(error))
            except StoreError as error:
                _log.error("hosts.yaml is in force and not stored", reason=str(error))

    async def _reload_policy(self) -> None:
        while True:
            try:
                await self._control.policies.reload(PolicyReload(), DISK)
            except RevisionChangedError:  # another revision came into force in the meantime
                continue
            return


# Return unused memory of control to the system.
#
# glibc keeps up to 64 MiB of freed memory for each thread that reads or writes large values. Mapping every large block
# separately would return it at once, but take twice as long.

_LOOK_SECONDS = 3.0
MUCH = 32 << 20


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


async def return_spare_memory(seconds: float = _LOOK_SECONDS) -> None:
    """Return free memory while the process has over `MUCH` bytes more than its minimum.

    This repeats even if the memory is in use, because the allocator keeps memory that is freed later.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only; other C libraries keep less memory
    least = resident()
    while True:
        await asyncio.sleep(seconds)
        least = min(least, size := resident())
        if trim is not None and size > least + MUCH:
            await asyncio.to_thread(trim, 0)


_log = structlog.get_logger()
_ADMIN = "admin"
_SWITCH_SECONDS = 0.0002
_GARBAGE = 10_000  # new objects between two garbage collections; many are records that wait to be written
_SAVE_SECONDS = 1.0
_TASKS_SECONDS = 0.4
_CLOSE_SECONDS = 1.2  # to close the store, and again to close the log; the supervisor kills control after 3 s
_WARNINGS = 100  # the most warnings of the policy in `Ready`


def main(lifeline_fd: int, config_path: Path) -> None:
    settings = load_resolved(config_path)
    # Limit how long the event loop waits for a thread (audit log, store, large values) that runs Python code.
    sys.setswitchinterval(_SWITCH_SECONDS)
    gc.set_threshold(_GARBAGE)
    uvloop.run(_run(settings, lifeline_fd, config_path))


async def _run(settings: Settings, lifeline_fd: int, config: Path) -> None:
    stopping = asyncio.Event()
    gate: StartGate = start_gate() or StartGate()
    compiler = SpecificationCompiler(
        lambda: lifeline.say(messages.CompilerWanted()), CompiledStore(settings.state / "control/compiled")
    )
    lifeline = ControlLifeline(
        lifeline_fd, stopping, {"compiler": (compiler.attach, messages.CompilerLink), **gate.links}
    )
    lifeline.attach()
    try:
        await lifeline.restored.wait()
        role = await gate.role(config, settings, lifeline, compiler, stopping)
        if role is None or stopping.is_set():
            return
        control = await _start(settings, lifeline, compiler, role, gate=gate)
    except (*STATE_ERRORS, NoPortError) as error:
        lifeline.say(messages.Failed(str(error)))
        await stopping.wait()
        return
    await stopping.wait()
    await control.end()


async def _start(
    settings: Settings,
    lifeline: ControlLifeline,
    compiler: SpecificationCompiler,
    role: ActiveRole,
    *,
    gate: StartGate,
) -> "_Service":
    if settings.monitors is not None:
        compiler.call_early()  # the compiler starts while the policy is read
    restarted = RVMASTER in lifeline.sockets
    control = Control(settings, lifeline, compiler, role)
    await control.begin()
    state_began = control.state_age.begin()
    control.policies.start(restarted=restarted or role.paired)
    control.places.policy_changed(control.policies.current.ports)
    for begun in control.policy_facts.first:
        begun()
    await control.monitors.start(restarted=restarted, taken_over=role.paired)
    state_began(control.monitors)
    control.features.add(await gate.begin(control))
    control.take_orders()
    await restore_nodes(control.sockets, control.store, control.graph, control.faces, control.serve_node)
    # The policy's file may have changed while the appliance was down, or control may have died during a change.
    control.enforcement.policy_changed(control.policies.current)
    service = _Service(control)
    await service.begin()
    await control.reconciler.ready.wait()
    await service.announce(restarted=restarted)
    return service


class _Service:
    """The service of control, from the first served call to the end."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self._messages = SupervisorMessages(control)
        self._tasks: list[asyncio.Task[None]] = []
        self._admin: object = None

    async def begin(self) -> None:
        control, listener_limits, sockets = (
            self._control,
            self._control.listener_limits,
            self._control.sockets,
        )
        calls, own = (control.pipeline.handler(control.table, own=own) for own in (False, True))
        listen = listener_limits.server
        watched = listener_limits.answering.watch(calls)
        await listener_limits.open(listen(sockets[RVMASTER].dup(), watched))
        await listener_limits.open(listen(sockets[OWN].dup(), own, guarded=False))
        # Do not keep connections alive: at each call, the ROS master queries the kernel about every open connection.
        await listener_limits.open(
            listen(sockets[INNER].dup(), control.inner.handle, guarded=False, keep=False)
        )
        if control.lifeline.announced:
            control.tokens.first_token_shown()
        if _ADMIN in sockets:
            # Keep a reference, otherwise the garbage collector closes the server.
            self._admin = await AdminServer(control.administration).start(sockets[_ADMIN].dup())
        if control.role.api is not None:
            control.rest.attach(control.role.api)
            control.hosts.enrolment.served_by(control.role.pin)  # the api has stated it already
        control.lifeline.hear(self._messages.heard)
        work: dict[str, Callable[[], Awaitable[None]]] = {
            "the reconciliation with the ROS master": control.reconciler.run,
            "the checks of nodes": control.liveness.run,
            "the reminders of subscribers": control.reminders.run,
            "the ends of connections": listener_limits.connection_table.sweep,
            "the ends of own connections": listener_limits.own_connection_table.sweep,
            "the return of memory": return_spare_memory,
            "the check of the clock": control.clock.watch,
            "the ends of tokens, blocks and other things": control.ends.run,
            "the check of protection that is off": control.switched_off.watch,
            "the storage of parameters": self._save_parameters,
            "the publications of monitors": partial(control.publisher.run, control.reconciler.ready),
            **control.features.work(),
        }
        loop = asyncio.get_running_loop()
        self._tasks += [loop.create_task(run_always(what, one)) for what, one in work.items()]

    async def announce(self, *, restarted: bool) -> None:
        control, settings = self._control, self._control.settings
        token = await control.tokens.first() if settings.api_address is not None else None
        host = settings.listen_address[0]
        own = master_address(settings) if host in {"0.0.0.0", "::"} else host  # noqa: S104 - compared only
        uri = node_uri(control.role.address or own, control.port(RVMASTER))
        control.lifeline.surroundings.master = uri.rstrip("/")
        if not restarted:
            name = {"robot": settings.name} if settings.name else {}
            more = {**name, "version": __version__, "configuration": settings.fingerprints()}
            more |= {"settings": settings.audit_values(), "off": control.monitors.off}
            control.trail.happened("appliance started", f"nodes may connect at {uri}", more=more)
        else:
            text = "control started again after an unexpected end: no host holds a group of [Authority]"
            control.trail.happened("process started", text, resource="control")
        detail = {
            "master": uri.rstrip("/"),
            "revision": control.policies.revision,
            "rosout_master": node_uri("127.0.0.1", control.port(OWN)).rstrip("/"),
            "inner_port": control.port(INNER),
            "token": token,
            "own_port": control.port(OWN),
            "warnings": [str(warning) for warning in control.policies.current.warnings[:_WARNINGS]],
        }
        control.lifeline.say(messages.Ready(detail))

    async def end(self) -> None:
        control = self._control
        control.listener_limits.close()
        control.faces.close_all()
        control.reminders.close()
        control.subscribers.delivery.close()
        control.rosmaster.close()
        control.role.close()
        await _end_others(_TASKS_SECONDS)  # requests may still write state while they end
        control.trail.happened("appliance stopped", "control ended in an orderly way")
        control.store.save_parameters(control.parameters.tree)
        control.store.close(_CLOSE_SECONDS)
        unwritten = control.audit.close(_CLOSE_SECONDS)
        if unwritten is not None:
            _log.error("the last records of the audit log are not written", reason=unwritten)

    async def _save_parameters(self) -> None:
        control = self._control
        dirty, store, mirror = control.parameters_dirty, control.store, control.parameters
        while True:
            await dirty.wait()
            dirty.clear()
            if mirror.unnoted or store.tree_is_due:
                mirror.unnoted = False
                store.save_parameters(mirror.tree)
            await asyncio.sleep(_SAVE_SECONDS)


async def _end_others(seconds: float) -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    if others:
        await asyncio.wait(others, timeout=seconds)
