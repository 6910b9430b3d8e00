"""Start, watch and restart the processes of the appliance.

1. The supervisor parses no data from a node or a browser. A child that sends a foreign message is killed.
2. A dead process is restarted within a second; a dispensable process that cannot serve, within a minute. A process
   that does not answer for five seconds is killed.
3. Once nodes may connect, only a request of control ends the appliance, never the death of a process.
4. If one end of a link is new, both ends get a new link. A new control first gets every kept socket, then its links,
   then the list of processes.
5. When the gate suspends the service, all processes that serve the robot are stopped (SIGSTOP). They go on if it
   resumes in the same epoch; otherwise they are killed, so no state in memory is older than the next epoch.
6. Stopping the appliance takes less than five seconds, even if children hang.
"""

import asyncio
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from functools import partial

import msgspec
import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.user_errors import UserError
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.ipsec.strongswan import PROGRAM as CHARON
from appliance.supervisor import rosmaster_probe, signals
from appliance.supervisor.clock_sync import clock_is_synchronised
from appliance.supervisor.errors import StartError
from appliance.supervisor.heartbeat_wiring import HeartbeatWiring
from appliance.supervisor.input_lender import lend_inputs
from appliance.supervisor.isolation_lifecycle import NoIsolation
from appliance.supervisor.isolation_watchdog import IsolationWatchdog
from appliance.supervisor.lapse_answers import answer_for_control
from appliance.supervisor.listener_store import ListenerRejectedError, ListenerStore
from appliance.supervisor.machine_work import MachineWork, NoMachineWork, Terms
from appliance.supervisor.monitor_memory import MonitorMemory
from appliance.supervisor.priority import PrioritizedProcess, keep_priorities
from appliance.supervisor.process_handle import (
    ANSWER_SECONDS,
    FIRST_ANSWER_SECONDS,
    LONGEST_START_SECONDS,
    ChildProcess,
    ProcessCallbacks,
    ProcessHandle,
    link_processes,
)
from appliance.supervisor.process_slot import FAILING_AFTER, ProcessSlot
from appliance.supervisor.role import Facts, Role, SharedMemory
from appliance.supervisor.service_gate import RoleChanges, ServiceGate
from appliance.supervisor.shutdown import end_all
from appliance.supervisor.users import account_of

ADMIN = "admin"
_READERS = "rosrv-api"  # the user whose group may read the audit log
_START_SECONDS = 180.0  # a longer start must show progress
_LOOK_SECONDS = 10.0
OUTPUT_LINES = 40  # last lines kept of a failing process
_LONGEST_LINE = 500  # characters
_SUSPENDED_SECONDS = 0.2  # until a start is tried again that a pause delays
_AGREED_SECONDS = 10.0  # that an ordered end waits for control
_UNANSWERED = "the supervisor killed it, because it did not answer"
_MAX_UNANSWERED = 4096  # requests of control at once

_FROM_ANY: tuple[type[messages.Message], ...] = (
    messages.Walled,
    messages.Pong,
    messages.Ready,
    messages.Failed,
)
_FROM_CONTROL: tuple[type[messages.Message], ...] = (
    messages.SocketKept,
    messages.SocketDropped,
    messages.RouteWanted,
    messages.EndpointWanted,
    messages.ApplianceStopRequested,
    messages.LogHeld,
    messages.TunnelsWanted,
    messages.CompilerWanted,
    messages.ProcessWanted,
    messages.ProcessOverdue,
    messages.NodeSilent,
    messages.OwnNetworkWanted,
    messages.MachineWorkWanted,
    messages.EndAgreed,
)
_FROM: dict[str, tuple[type[messages.Message], ...]] = {
    "control": _FROM_CONTROL,
    "relay": (messages.HeartbeatLineWanted,),
}

log = structlog.get_logger()


class ControlReady(msgspec.Struct, frozen=True):
    """The `Ready.detail` of control."""

    master: str
    revision: int
    rosout_master: str
    inner_port: int
    own_port: int
    token: str | None = None
    warnings: tuple[str, ...] = ()  # of the policy in force


class Supervisor:
    """The processes of one appliance, from start to end of `run`."""

    def __init__(
        self,
        roles: tuple[Role, ...],
        facts: Facts,
        *,
        admin: socket.socket,
        ready: Callable[[ControlReady], None],
        relays: int = 1,
        isolation: NoIsolation | None = None,
        listeners: Mapping[str, socket.socket] | None = None,
        memories: Sequence[SharedMemory] = (),
        memory: MonitorMemory | None = None,
        heartbeat: HeartbeatWiring | None = None,
        stands_by: Callable[[], None] = lambda: None,
        gate: Callable[[RoleChanges], ServiceGate] = ServiceGate,
        work: MachineWork | None = None,
        gives_back: Callable[[], None] = lambda: None,
    ) -> None:
        """`ready` and `stands_by` are called at most once; `ready` may raise `StartError`. `gives_back` is called
        before an ordered end gives a graph back.

        Without `memory`, the state of monitors is lost when relays die.
        """
        self._facts = facts
        self.slots = [
            ProcessSlot(role, index)
            for role in roles
            for index in range((role.most or relays) if role.indexed else 1)
        ]
        self.kept = ListenerStore()
        self.kept.keep(ADMIN, admin.detach())
        self._listeners = dict(listeners or {})
        self._memories = memories
        self._memory, self._heartbeat, self._line_failed = memory, heartbeat, ""
        self._ready = ready
        self.is_ready = False
        self._stands_by = stands_by
        self._parked = False
        self._gate = gate(RoleChanges(self._activate, self._passivate, self._suspend, self._resume))
        self._suspended_at = 0.0
        self._answers: asyncio.Task[None] | None = None  # to operators, instead of control
        self._watchdog = IsolationWatchdog(
            isolation or NoIsolation(), self._tell_control, self._record_restored
        )
        self.reports = ProcessCallbacks(self._on_message, self._on_violation, self.died)
        self._work = work or NoMachineWork()
        self._gives_back = gives_back
        self.stopping = asyncio.Event()
        self._end_agreed = asyncio.Event()
        self._process_died = asyncio.Event()
        self._lacking: set[tuple[str, ...]] = set()
        self.failure: str | None = None
        self._serving: ProcessHandle | None = None  # the control that records what happens
        self._deaths: dict[tuple[str, int], messages.ProcessDied] = {}  # until control has got them
        self._restored: deque[messages.RulesRestored] = deque(maxlen=100)  # as these
        self._asking: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._unanswered = 0
        self._clock = messages.ClockRead(clock_is_synchronised())
        self._since = clock.Began()

    async def run(self) -> None:
        """Run until SIGTERM or SIGINT; SIGHUP reloads the policy. Raises `StartError`."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_log_fault)
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.stop)
        loop.add_signal_handler(signal.SIGHUP, lambda: self._tell_control(messages.PolicyReloadRequested()))
        with signals.hear():
            await self._serve()
        if self.failure is not None:
            raise StartError(self.failure)

    async def _serve(self) -> None:
        self._spawn(self._watch())
        self._spawn(self._watchdog.watch())
        try:
            await self._start()
            self._spawn(self._watchdog.run())
            self._spawn(keep_priorities(self._prioritize))
            await self.stopping.wait()
            await self._announce_end()
        finally:
            await self.end()
            self.kept.close()
            for listener in self._listeners.values():
                listener.close()
            for shared in self._memories:
                shared.close()
            if self._memory is not None:
                self._memory.close()
            if self._heartbeat is not None:
                self._heartbeat.close()

    def stop(self, failure: str | None = None) -> None:
        if not self.stopping.is_set():
            self.failure = failure
            self.stopping.set()

    async def _announce_end(self) -> None:
        """Let control give a graph back that it took over, unless the appliance ends because of a failure."""
        if self.failure is not None or not self._work.takes_over():
            return
        if self.is_ready:
            await asyncio.to_thread(self._gives_back)
            self._work.end()
            self._tell_control(messages.EndAnnounced())
            with suppress(TimeoutError):
                async with asyncio.timeout(_AGREED_SECONDS):
                    await self._end_agreed.wait()
        if self._work.holds() or (self.is_ready and not self._end_agreed.is_set()):
            log.error("control did not give the robot's graph back: sudo rosrv release --dead")

    # --- starting -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        for slot in self.slots:
            if slot.role.after is None and not slot.role.on_demand and not self.stopping.is_set():
                self.start(slot)
                if slot.role.asks:
                    await self.until_answering(slot)
                    reason = await self._watchdog.look()
                    if reason is not None:
                        self.stop(reason)
        self._spawn(self.until_ready())

    async def until_answering(self, slot: ProcessSlot) -> None:
        began = clock.now()
        while self._gets_on(began, [slot]) and not self.stopping.is_set():
            process = slot.process
            if process is not None and await self.answers(1.0) and slot.process is process:
                process.note_answer()
                return
            with suppress(TimeoutError):
                async with asyncio.timeout(0.05):
                    await self.stopping.wait()
        self.stop(f"rosmaster does not answer on 127.0.0.1:{self._facts.rosmaster_port}; check the log")

    async def until_ready(self) -> None:
        began = clock.now()
        while not self.is_ready and not self.stopping.is_set():
            with suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_SECONDS):
                    await self.stopping.wait()
            late = [slot for slot in self.slots if slot.is_late]
            words = ", ".join(slot.role.name for slot in late) or "the firewall around control's ports"
            waited = round(clock.now() - began)
            if self.is_ready or self._parked or self.stopping.is_set():
                return
            if not self._gets_on(began, late):
                self.stop(
                    f"the appliance was not ready after {waited} seconds; still waiting for {words}; check the log"
                )
            else:
                log.info("still starting", waits_for=words, seconds=waited)

    def _gets_on(self, began: float, slots: list[ProcessSlot]) -> bool:
        waited = clock.now() - began
        if waited < _START_SECONDS:
            return True
        still = min((slot.process.stalled_seconds for slot in slots if slot.process is not None), default=0.0)
        return waited < LONGEST_START_SECONDS and still < FIRST_ANSWER_SECONDS

    def start(self, slot: ProcessSlot) -> None:
        slot.due = None
        if self._gate.suspended and slot.role.serves_robot:
            slot.due = asyncio.get_running_loop().call_later(_SUSPENDED_SECONDS, self.start, slot)
            return
        slot.wanted = False
        if self.stopping.is_set() or not self._may_start(slot):
            return
        try:
            slot.process = self._process_for(slot)
        except Exception as error:  # else no event would ever start it
            slot.short_runs += 1
            defect = None if isinstance(error, OSError | UserError) else error
            log.error("process cannot be started", role=slot.role.name, error=str(error), exc_info=defect)
            self._start_later(slot)
            return
        slot.starts += 1
        log.info("process started", role=slot.role.name, pid=slot.process.pid, restarts=slot.starts - 1)
        if slot.role.name == "control":
            self._equip_control(slot.process)
        if slot.role.listens:
            slot.process.send(
                messages.SocketRestored(slot.role.name), (self._listeners[slot.role.name].fileno(),)
            )
        for shared in self._memories:
            for given, descriptor in shared.messages_for(slot.role.name, slot.index):
                slot.process.send(given, (descriptor,))
        for state, descriptor in (
            self._memory.messages_for(slot.role.name, slot.index) if self._memory else ()
        ):
            slot.process.send(state, (descriptor,))
        for memory, descriptor in self._heartbeat.messages_for(slot.role.name) if self._heartbeat else ():
            slot.process.send(memory, (descriptor,))
        self._link(slot)
        self._tell_processes()

    def _process_for(self, slot: ProcessSlot) -> ProcessHandle:
        here, there = socket.socketpair()
        with ExitStack() as unused, there:
            unused.callback(here.close)
            with lend_inputs(slot.role.inputs(self._facts)) or nullcontext() as lender:
                with self._watchdog.isolation.inside():
                    plan = slot.plan(self._facts, there.fileno(), lender.fileno() if lender else None)
                    child = ChildProcess(slot.role.name, plan)
                lifeline = Channel(here, messages.Lifeline, longest=1 << 20)
                process = ProcessHandle(slot.role.name, slot.index, child, lifeline, self.reports)
            unused.pop_all()
            return process

    def _may_start(self, slot: ProcessSlot) -> bool:
        return self._gate.active or slot.role.after is None or slot.role.stands_by

    def _equip_control(self, process: ProcessHandle) -> None:
        if self._gate.member and self._gate.epoch is not None:
            process.send(messages.Activated(self._gate.epoch))
        for name, descriptor in self.kept:
            process.send(messages.SocketRestored(name), (descriptor,))
        process.send(self._watchdog.machine())  # before control decides by its policy
        process.send(messages.SocketsRestored(len(self.kept), self.is_ready))
        for message in (*self._watchdog.news(), self._clock):
            process.send(message)

    def _link(self, slot: ProcessSlot) -> None:
        for other in self.slots:
            if other.role.name in slot.role.links and slot.process is not None and other.process is not None:
                link_processes(slot.process, other.process)

    # --- messages of children -----------------------------------------------------------------------------

    def _on_message(self, process: ProcessHandle, message: object, descriptors: tuple[int, ...]) -> None:
        decisive = self._gate.accepts.get(process.role, ())
        allowed = _FROM_ANY + decisive + _FROM.get(process.role, ())
        if not isinstance(message, allowed):
            for descriptor in descriptors:
                os.close(descriptor)
            self._on_violation(process, f"sent {type(message).__name__}, which it may not send")
            return
        match message:
            case messages.Walled():
                self._on_sandboxed(process, message)
            case messages.Pong():
                process.note_answer()
            case messages.Ready(detail):
                self._child_ready(process, detail)
            case messages.Failed(said, output):
                self._cannot_serve(process, _printable(said), output)
            case messages.HeartbeatLineWanted() if self._heartbeat is not None:
                self._give_line(process, self._heartbeat)
            case _ if isinstance(message, decisive):
                self._gate.heard(message)
            case _:
                self.control_said(process, message, descriptors)

    def _give_line(self, process: ProcessHandle, heartbeat: HeartbeatWiring) -> None:
        try:
            line, reason = heartbeat.open_line(), ""
        except OSError as error:
            line, reason = -1, str(error)
        if reason and reason != self._line_failed:
            log.error("the serial line of the heartbeat cannot be opened", reason=reason)
        self._line_failed = reason
        if line >= 0:
            process.send(messages.HeartbeatGiven(line=True), (line,))
            os.close(line)

    def _on_sandboxed(self, process: ProcessHandle, sandbox: messages.Walled) -> None:
        """Note the limits of a process, which only its first message may report."""
        if process.sandbox is not None:
            self._on_violation(process, "reported its sandbox twice")
            return
        process.sandbox = sandbox
        lacks = tuple(_printable(lack) for lack in sandbox.lacks)
        if lacks and lacks not in self._lacking:  # on one kernel all processes lack the same
            self._lacking.add(lacks)
            log.warning("sandbox is incomplete: rosrv status", role=process.role, lacks=list(lacks))
        self._tell_processes()

    def _cannot_serve(self, process: ProcessHandle, reason: str, output: Sequence[str]) -> None:
        """Kill the process, whose next start may succeed; end the appliance only if it is still starting."""
        slot = next(slot for slot in self.slots if slot.process is process)
        process.reason = reason
        process.output = tuple(_printable(line)[:_LONGEST_LINE] for line in output[-OUTPUT_LINES:])
        if self.is_ready or slot.role.dispensable:
            log.error("process cannot serve", role=process.role, reason=reason, output=list(process.output))
            process.kill()
        else:
            self.stop(reason)  # the reason becomes the last line of the output

    def control_said(
        self, process: ProcessHandle, message: messages.Message, descriptors: tuple[int, ...]
    ) -> None:
        match message:
            case messages.SocketKept(name):
                self._keep(process, name, descriptors[0])
            case messages.SocketDropped(name):
                if name != ADMIN:
                    self.kept.drop(name)
            case messages.RouteWanted(host):
                self._answer(process, self._route(process, host))
            case messages.EndpointWanted():
                self._answer(process, self._tell_endpoint(process))
            case messages.TunnelsWanted(pool, address):
                self._answer(process, self._open_tunnels(process, pool, address))
            case messages.LogHeld(processes):
                self._free_log(processes)
            case messages.CompilerWanted():
                self._demand("compiler")
            case messages.ProcessWanted(role, index):
                self._demand(role, index)
            case messages.ProcessOverdue(role, index):
                self._dismiss(role, index)
            case messages.ApplianceStopRequested(reason):
                log.warning("control requests the shutdown of the appliance", reason=reason)
                self.stop()
            case _:
                self._said_further(process, message)

    def _said_further(self, process: ProcessHandle, message: messages.Message) -> None:
        match message:
            case messages.MachineWorkWanted(number, _feature, work, terms):
                self._answer(process, self._carry_out(process, number, work, terms))
            case messages.NodeSilent(role):
                self._end_silent(role)
            case messages.OwnNetworkWanted(network, ports):
                self._answer(process, self._open_own_network(process, network, ports))
            case messages.EndAgreed():
                self._end_agreed.set()

    def _free_log(self, processes: list[int]) -> None:
        """Kill the readers that hold a writer's lock of the audit log; a correct reader never holds one.

        If the holder is unknown (-1), kill all readers.
        """
        ours = {slot.process.pid for slot in self.slots if slot.process is not None}
        for slot in self.slots:
            if _READERS not in {slot.role.user, slot.role.group} or slot.process is None:
                continue
            if slot.process.pid in processes or not ours.issuperset(processes):
                role, pid = slot.role.name, slot.process.pid
                log.critical("process is stopped: the audit log stays locked", role=role, pid=pid)
                slot.process.kill()

    def _keep(self, process: ProcessHandle, name: str, descriptor: int) -> None:
        if name == ADMIN:
            os.close(descriptor)
            self._on_violation(process, "sent a socket under the name of the admin socket")
            return
        try:
            self.kept.keep(name, descriptor)
        except ListenerRejectedError as error:
            log.error("socket is not kept: a restart of control would close it", reason=str(error))

    def _child_ready(self, process: ProcessHandle, detail: dict[str, object]) -> None:
        process.ready = True
        process.note_answer()
        if process.role == "relay":
            process.congestion = _printable(str(detail.get("congestion", "")))[:16]
            self._tell_processes()
        if process.role != "control":
            return
        if detail.get("stands_by"):
            self._note_parked()
            return
        try:
            said = msgspec.convert(detail, ControlReady)
        except msgspec.ValidationError as error:
            self._on_violation(process, f"reported ready without an address: {error}")
            return
        self._serving = process
        self._tell_deaths()
        self._facts = replace(self._facts, rosout_master=said.rosout_master)
        self._leave_answers()
        self._spawn(self.control_ready(process, said))

    # --- one of two appliances ----------------------------------------------------------------------------

    def _note_parked(self) -> None:
        self._leave_answers()
        for slot in self.slots:
            if slot.role.stands_by and slot.is_free:
                self.start(slot)
        if not self._parked:
            self._parked = True
            self._stands_by()

    def _activate(self, epoch: int) -> None:
        log.info("this appliance is active", epoch=epoch)
        self._tell_control(messages.Activated(epoch))

    def _passivate(self) -> None:
        log.warning("this appliance is not active any more; its processes start again, passive")
        self._tell("api", messages.ServicePaused(""))
        self._answer_for_control(self._gate.ended_text)
        for name, _descriptor in self.kept:
            if name != ADMIN:
                self.kept.drop(name)
        for slot in self.slots:
            if slot.due is not None and not self._may_start(slot):
                slot.due.cancel()
                slot.due = None
            if slot.process is not None and not slot.role.outlives_takeover:
                slot.pardoned = True
                slot.process.kill()

    def _suspend(self) -> bool:
        """Stop the processes that serve the robot; return False if any of them is only starting.

        A control that was on standby does not count as starting, so a lapse soon after the activation does not end
        the appliance.
        """
        serving = [(slot, slot.process) for slot in self.slots if slot.role.serves_robot]
        if any(slot.is_starting for slot, process in serving if process is not None):
            return False
        for _slot, process in serving:
            if process is not None:
                process.kill(signal.SIGSTOP)
        self._suspended_at = clock.now()
        self._answer_for_control(self._gate.paused)
        self._tell("api", messages.ServicePaused(self._gate.paused))
        log.warning("the lease has lapsed; nothing is answered or relayed until it is renewed")
        return True

    def _resume(self) -> None:
        seconds = clock.now() - self._suspended_at
        self._tell("api", messages.ServicePaused(""))
        self._leave_answers()
        for slot in self.slots:
            if slot.process is not None and slot.role.serves_robot:
                slot.process.kill(signal.SIGCONT)
                slot.process.discount_pause(seconds)
        log.warning("the lease is renewed in the same epoch; the service goes on", seconds=round(seconds, 3))

    def _answer_for_control(self, reason: str) -> None:
        self._leave_answers()
        self._answers = self._spawn(answer_for_control(partial(self.kept.copy_of, ADMIN), reason))

    def _leave_answers(self) -> None:
        if self._answers is not None:
            self._answers.cancel()
            self._answers = None

    # --- readiness ----------------------------------------------------------------------------------------

    async def control_ready(self, process: ProcessHandle, said: ControlReady) -> None:
        reason = await self._watchdog.control_ready(said.inner_port, said.own_port)
        while self._gate.suspended and process.alive:
            await asyncio.sleep(_SUSPENDED_SECONDS)
        if reason is not None and not self.is_ready:
            self.stop(reason)
        if self.stopping.is_set() or not process.alive or not self._gate.active:
            return
        for slot in self.slots:
            if slot.role.after == process.role and slot.is_free:
                self.start(slot)
        if not self.is_ready:
            try:
                self._ready(said)
            except StartError as error:
                self.stop(str(error))
                return
            self.is_ready = True
            process.send(messages.Announced())

    def _answer(self, process: ProcessHandle, work: Coroutine[object, object, None]) -> None:
        if self._unanswered >= _MAX_UNANSWERED:
            work.close()
            self._on_violation(process, f"sent more than {_MAX_UNANSWERED} requests at once")
            return
        self._unanswered += 1
        self._spawn(work).add_done_callback(self._on_answer)

    def _on_answer(self, _task: asyncio.Task[None]) -> None:
        self._unanswered -= 1

    async def _route(self, process: ProcessHandle, host: str) -> None:
        process.send(messages.RouteFound(host, await self._watchdog.route_to(host)))

    async def _tell_endpoint(self, process: ProcessHandle) -> None:
        process.send(await self._watchdog.endpoint())

    async def _open_tunnels(self, process: ProcessHandle, pool: str, address: str) -> None:
        if all(slot.role.name != "charon" for slot in self.slots):
            process.send(messages.TunnelsEnclosed(None, "this appliance has no tunnels: install rosrv again"))
            return
        if not CHARON.exists():
            reason = (
                f"{CHARON} is missing: apt install charon-systemd strongswan-swanctl libcharon-extra-plugins"
            )
            process.send(messages.TunnelsEnclosed(None, reason))
            return
        answer = await self._watchdog.open_tunnels(pool, address)
        if answer.esp is not None:
            self._demand("charon")
        process.send(answer)

    async def _open_own_network(self, process: ProcessHandle, network: str, ports: list[int]) -> None:
        process.send(messages.OwnNetworkOpened(await self._watchdog.open_own_network(network, ports)))

    async def _carry_out(self, process: ProcessHandle, number: int, work: str, terms: Terms) -> None:
        process.send(await self._watchdog.carry_out(self._work, number, work, terms))

    def _demand(self, role: str, index: int = 0) -> None:
        for slot in self.slots:
            if slot.role.name == role and slot.index == index and slot.role.on_demand:
                slot.wanted = slot.process is not None
                if slot.is_free:
                    self.start(slot)

    def _dismiss(self, role: str, index: int) -> None:
        for slot in self.slots:
            if slot.role.name == role and slot.index == index and slot.role.on_demand and slot.process:
                log.error("process did not end in time and is killed", role=role, pid=slot.process.pid)
                slot.dismissed = True
                slot.process.kill()

    def _end_silent(self, role: str) -> None:
        for slot in self.slots:
            # The supervisor asks all others itself.
            alone = slot.role.program is not None and not slot.role.asks
            if slot.role.name == role and alone and slot.process is not None:
                _kill_silent(slot.process)

    def _spawn(self, work: Coroutine[object, object, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_finish)
        return task

    def _on_finish(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log_fault(task.get_loop(), {"message": "a task failed", "exception": error})

    def _on_violation(self, process: ProcessHandle, what: str) -> None:
        log.critical("process is killed", role=process.role, pid=process.pid, reason=f"it {what}")
        process.reason = f"the supervisor killed it, because it {what}"
        process.kill()

    # --- watching -----------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        before = clock.now()
        while True:
            await asyncio.sleep(1.0)
            now = clock.now()
            slept, before = now - before - 1.0, now
            for slot in self.slots:
                suspended = self._gate.suspended and slot.role.serves_robot
                if slot.process is not None and not suspended:
                    self._look_at(slot, slot.process, slept)
                if slot.recovers():
                    self._tell_processes()
            if self._watchdog.machine_has_changed():
                self._spawn(self._watchdog.take_machine())
            read = messages.ClockRead(clock_is_synchronised())
            if read != self._clock:
                self._clock = read
                self._tell_control(read)

    def _prioritize(self) -> list[PrioritizedProcess]:
        usual = os.getpriority(os.PRIO_PROCESS, 0) + self._facts.raised
        return [
            PrioritizedProcess(slot.process.pid, usual + slot.role.nice, usual)
            for slot in self.slots
            if slot.role.nice_if_busy and slot.process is not None and slot.process.ready
        ]

    def _look_at(self, slot: ProcessSlot, process: ProcessHandle, slept: float) -> None:
        if slept > 1.0:
            process.discount_pause(slept)
        if slot.role.asks:
            self._ask(process)
        elif process.is_program:
            return
        else:
            process.ping()
        if process.is_hanging:
            _kill_silent(process)

    def _ask(self, process: ProcessHandle) -> None:
        if self._asking is None or self._asking.done():
            self._asking = self._spawn(self._listen_to(process))

    async def _listen_to(self, process: ProcessHandle) -> None:
        if await self.answers(2 * ANSWER_SECONDS):
            process.note_answer()

    async def answers(self, seconds: float) -> bool:
        inside = self._watchdog.isolation.inside()
        return await rosmaster_probe.answers(self._facts.rosmaster_port, account_of("rosrv"), inside, seconds)

    def died(self, process: ProcessHandle, code: int) -> None:
        slot = next(slot for slot in self.slots if slot.process is process)
        lived = slot.record_death(process)
        self._process_died.set()
        if self.stopping.is_set():
            return
        self._gate.died(slot.role.name, serves_robot=slot.role.serves_robot)
        if slot.role.on_demand and (code == 0 or slot.dismissed):
            self._ended(slot)
            return
        if slot.pardoned:
            slot.pardoned = False
            if slot.role.name == "charon":
                self._spawn(self._watchdog.clear_tunnels(lambda: not self._gate.active))
            if not slot.role.on_demand or slot.wanted:
                self.start(slot)
            return
        log.error(
            "process died", role=process.role, pid=process.pid, end=_end_of(code), lived=round(lived, 3)
        )
        slot.reason, slot.output = process.reason or f"it ended with {_end_of(code)}", process.output
        self._note_death(slot, process, code, lived)
        self._tell_processes()
        if slot.is_failing:
            if not self.is_ready:
                self.stop(
                    f"{process.role} died {counted(slot.short_runs, 'time')} ({_end_of(code)}); check the log"
                )
                return
            log.critical(
                "process keeps crashing", role=process.role, times=slot.short_runs, reason=slot.reason,
                again_in=slot.delay(),
            )  # fmt: skip
        self._start_later(slot)

    def _note_death(self, slot: ProcessSlot, process: ProcessHandle, code: int, lived: float) -> None:
        """Tell control, which records it, unless `process failing` is recorded already."""
        if process is self._serving:
            self._serving = None
        if slot.short_runs <= FAILING_AFTER:
            self._deaths[slot.role.name, slot.index] = messages.ProcessDied(
                slot.role.name, slot.index, process.pid, _end_of(code), slot.reason, lived, slot.starts - 1
            )
            self._tell_deaths()

    def _tell_deaths(self) -> None:
        if self._serving is None:
            return
        for message in (*self._deaths.values(), *self._restored):
            self._serving.send(message)
        self._deaths.clear()
        self._restored.clear()

    def _record_restored(self, message: messages.RulesRestored) -> None:
        self._restored.append(message)
        self._tell_deaths()

    def _ended(self, slot: ProcessSlot) -> None:
        log.info("process ended", role=slot.role.name)
        slot.starts -= 1
        slot.short_runs, slot.dismissed = 0, False
        self._tell_processes()
        if slot.wanted:
            self.start(slot)

    def _start_later(self, slot: ProcessSlot) -> None:
        slot.due = asyncio.get_running_loop().call_later(slot.delay(), self.start, slot)

    def _tell_processes(self) -> None:
        rows = [_about(slot) for slot in self.slots if slot.process is not None or slot.is_failing]
        own = messages.ProcessInfo("supervisor", os.getpid(), self._since.text(), 0)
        self._tell_control(messages.ProcessesChanged([own, *rows]))

    def _tell_control(self, message: messages.Message) -> None:
        self._tell("control", message)

    def _tell(self, role: str, message: messages.Message) -> None:
        for slot in self.slots:
            if slot.role.name == role and slot.process is not None:
                slot.process.send(message)

    # --- ending -------------------------------------------------------------------------------------------

    async def end(self) -> None:
        failed = self.failure is not None or not self.stopping.is_set()
        self.stopping.set()
        for task in self._tasks:
            task.cancel()
        for slot in self.slots if self._gate.suspended else ():
            if slot.process is not None and slot.role.serves_robot:
                slot.process.kill()  # it is stopped, and cannot end in order
        await end_all(self.slots, self._process_died, failed=failed)


def _log_fault(_loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
    # A defect in one callback must not stop the robot's master: log the defect and continue.
    log.critical("fault in the supervisor", fault=context["message"], exc_info=context.get("exception"))


def _kill_silent(process: ProcessHandle) -> None:
    if process.reason != _UNANSWERED:
        log.error("process does not answer and is killed", role=process.role, pid=process.pid)
    process.reason = _UNANSWERED
    process.kill()


def _about(slot: ProcessSlot) -> messages.ProcessInfo:
    failing, output = (slot.reason, list(slot.output)) if slot.is_failing else ("", [])
    process, restarts = slot.process, slot.starts - 1
    if process is None:
        since = slot.since.text()
        return messages.ProcessInfo(slot.role.name, 0, since, restarts, failing=failing, output=output)
    sandbox, lacks = process.sandbox_state
    return messages.ProcessInfo(
        slot.role.name,
        process.pid,
        process.since.text(),
        restarts,
        sandbox,
        lacks,
        process.congestion,
        failing,
        output,
    )


def _printable(text: str) -> str:
    return "".join(
        character if character.isprintable() or character == "\n" else ascii(character)[1:-1]
        for character in text
    )


def _end_of(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
