"""Starts, watches and restarts the processes of the appliance.

Invariants:

1. Nothing that comes from a node or a browser is parsed here. From a child come only the messages in
   `_FROM_ANY` and `_FROM_CONTROL`; a child that sends anything else is killed and started again.
2. A process that dies is started again within a second; one that does not answer for five seconds is killed.
3. Once nodes may connect, nothing that a process says of itself or dies of ends the appliance, but the end that
   control was granted; who cannot serve (a full disk) is tried again, after a second at most.
4. Whenever one end of a link is new, both ends get a fresh link; a new control gets every kept socket
   back first, then its links, then who is running.
5. Ending takes less than five seconds, whatever the children do, and leaves no process behind.
"""

import asyncio
import os
import signal
import socket
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import msgspec
import structlog

from appliance.channel import messages
from appliance.ipsec.charon import PROGRAM as CHARON
from appliance.supervisor import rosmaster_probe, signals
from appliance.supervisor.clock_sync import clock_is_synchronised
from appliance.supervisor.errors import StartError
from appliance.supervisor.inherited_listeners import KeptSockets, RefusedSocketError
from appliance.supervisor.isolation_lifecycle import Enclosure
from appliance.supervisor.isolation_watchdog import Guard
from appliance.supervisor.monitor_memory import MonitorMemory
from appliance.supervisor.process_handle import (
    ANSWER_SECONDS,
    FIRST_ANSWER_SECONDS,
    LONGEST_START_SECONDS,
    Life,
    Reports,
    link,
)
from appliance.supervisor.process_slot import Post
from appliance.supervisor.rings import Rings
from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.shutdown import end_all
from appliance.supervisor.users import account_of

ADMIN = "admin"
_READERS = "rosrv-api"  # the user whose group may read the audit log
_START_SECONDS = 180.0  # without any progress
_LOOK_SECONDS = 10.0
OUTPUT_LINES = 40  # of a failing process, that are kept
_LONGEST_LINE = 500  # characters
_MOST_UNANSWERED = 4096  # hosts of which control asks the way

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
)

log = structlog.get_logger()


class ControlReady(msgspec.Struct, frozen=True):
    """What control says when nodes may connect (`Ready.detail`)."""

    master: str
    revision: int
    rosout_master: str
    inner_port: int
    own_port: int
    token: str | None = None
    warnings: tuple[str, ...] = ()  # of the policy in force


class Supervisor:
    """The processes of one appliance. `run` is its whole life."""

    def __init__(
        self,
        roles: tuple[Role, ...],
        facts: Facts,
        *,
        admin: socket.socket,
        ready: Callable[[ControlReady], None],
        relays: int = 1,
        enclosure: Enclosure | None = None,
        listeners: Mapping[str, socket.socket] | None = None,
        rings: Rings | None = None,
        memory: MonitorMemory | None = None,
    ) -> None:
        """`admin` is handed to control; `ready` is called once, when nodes may connect; it may raise `StartError`.

        `listeners` are the sockets of the roles that listen; they stay open here over a role's death, so that
        connections wait for its next life. `rings` is the memory of the flight recorder; None: nothing is recorded.
        `memory` is what relays keep the state of monitors in; None: it dies with them.
        """
        self._facts = facts
        self.posts = [Post(role, index) for role in roles for index in range(relays if role.indexed else 1)]
        self.kept = KeptSockets()
        self.kept.keep(ADMIN, admin.detach())
        self._listeners = dict(listeners or {})
        self._rings = rings
        self._memory = memory
        self._ready = ready
        self.is_ready = False
        self._guard = Guard(enclosure or Enclosure(), self._tell_control)
        self._reports = Reports(self._received, self._violated, self.died)
        self.stopping = asyncio.Event()
        self._someone_died = asyncio.Event()
        self.failure: str | None = None
        self._asking: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._unanswered = 0
        self._clock = messages.ClockRead(clock_is_synchronised())
        self._since = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

    async def run(self) -> None:
        """Start everything, keep it running, and end it on SIGTERM or SIGINT; SIGHUP reloads the policy.

        Raises `StartError` when the appliance cannot start or go on; by then everything is stopped.
        """
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_log_fault)
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.stop)
        loop.add_signal_handler(signal.SIGHUP, lambda: self._tell_control(messages.PolicyReloadRequested()))
        with signals.heard():
            await self._serve()
        if self.failure is not None:
            raise StartError(self.failure)

    async def _serve(self) -> None:
        self._spawn(self._watch())
        try:
            await self._start()
            self._spawn(self._guard.run())
            await self.stopping.wait()
        finally:
            await self._end()
            self.kept.close()
            for listener in self._listeners.values():
                listener.close()
            if self._rings is not None:
                self._rings.close()
            if self._memory is not None:
                self._memory.close()

    def stop(self, failure: str | None = None) -> None:
        """End the appliance; `failure` is why it cannot go on, nothing for an orderly end."""
        if not self.stopping.is_set():
            self.failure = failure
            self.stopping.set()

    # --- starting -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        for post in self.posts:
            if post.role.after is None and not post.role.on_demand and not self.stopping.is_set():
                self.fill(post)
                if post.role.asks:
                    await self.until_answering(post)
                    reason = await self._guard.look()
                    if reason is not None:
                        self.stop(reason)
        self._spawn(self.until_ready())

    async def until_answering(self, post: Post) -> None:
        """Wait until the process at this post answers over HTTP, in whichever of its lives."""
        began = time.monotonic()
        while self._gets_on(began, [post]) and not self.stopping.is_set():
            life = post.life
            if life is not None and await self.answers(1.0) and post.life is life:
                life.heard()
                return
            with suppress(TimeoutError):
                await asyncio.wait_for(self.stopping.wait(), 0.05)
        self.stop(f"rosmaster does not answer on 127.0.0.1:{self._facts.rosmaster_port}; the log may say why")

    async def until_ready(self) -> None:
        """Say what the start waits for, and give it up when nothing gets on any more."""
        began = time.monotonic()
        while not self.is_ready and not self.stopping.is_set():
            with suppress(TimeoutError):
                await asyncio.wait_for(self.stopping.wait(), _LOOK_SECONDS)
            late = [post for post in self.posts if post.is_late]
            words = ", ".join(post.role.name for post in late) or "the firewall around control's ports"
            waited = round(time.monotonic() - began)
            if self.is_ready or self.stopping.is_set():
                return
            if not self._gets_on(began, late):
                self.stop(
                    f"the appliance was not ready after {waited} seconds, it waited for {words}; the log says more"
                )
            else:
                log.info("still starting", waits_for=words, seconds=waited)

    def _gets_on(self, began: float, posts: list[Post]) -> bool:
        """Whether a start that began then is waited for: for some minutes, and longer where processes get on."""
        waited = time.monotonic() - began
        if waited < _START_SECONDS:
            return True
        still = min((post.life.still_seconds for post in posts if post.life is not None), default=0.0)
        return waited < LONGEST_START_SECONDS and still < FIRST_ANSWER_SECONDS

    def fill(self, post: Post) -> None:
        """Start a process at this post; one that cannot be made is tried again, ever later."""
        post.due = None
        post.wanted = False
        if self.stopping.is_set():
            return
        here, there = socket.socketpair()
        try:
            with self._guard.enclosure.inside():
                plan = post.plan(self._facts, there.fileno())
                post.life = Life(post.role.name, post.index, plan, here, self._reports)
        except OSError as error:
            here.close()
            post.short_lives += 1
            log.error("process cannot be started", role=post.role.name, error=str(error))
            self._fill_later(post)
            return
        finally:
            there.close()
        post.lives += 1
        log.info("process started", role=post.role.name, pid=post.life.pid, restarts=post.lives - 1)
        if post.role.name == "control":
            self._equip_control(post.life)
        if post.role.listens:
            post.life.send(
                messages.SocketRestored(post.role.name), (self._listeners[post.role.name].fileno(),)
            )
        for given, descriptor in self._rings.given_to(post.role.name, post.index) if self._rings else ():
            post.life.send(given, (descriptor,))
        for state, descriptor in self._memory.given_to(post.role.name, post.index) if self._memory else ():
            post.life.send(state, (descriptor,))
        self._link(post)
        self._tell_processes()

    def _equip_control(self, life: Life) -> None:
        for name, descriptor in self.kept:
            life.send(messages.SocketRestored(name), (descriptor,))
        life.send(messages.SocketsRestored(len(self.kept), self.is_ready))
        for message in (*self._guard.news(), self._clock):
            life.send(message)

    def _link(self, post: Post) -> None:
        for other in self.posts:
            if other.role.name in post.role.links and post.life is not None and other.life is not None:
                link(post.life, other.life)

    # --- what children say --------------------------------------------------------------------------------

    def _received(self, life: Life, message: Any, descriptors: tuple[int, ...]) -> None:
        allowed = _FROM_ANY + (_FROM_CONTROL if life.role == "control" else ())
        if not isinstance(message, allowed):
            for descriptor in descriptors:
                os.close(descriptor)
            self._violated(life, f"sent {type(message).__name__}, which it may not send")
            return
        match message:
            case messages.Walled():
                self._walled(life, message)
            case messages.Pong():
                life.heard()
            case messages.Ready(detail):
                self._child_ready(life, detail)
            case messages.Failed(said, output):
                self._cannot_serve(life, _printable(said), output)
            case _:
                self.control_said(life, message, descriptors)

    def _walled(self, life: Life, walls: messages.Walled) -> None:
        """What it is enclosed in, by its own first word: what it says later is not believed."""
        if life.walls is not None:
            self._violated(life, "told twice what walls it is in")
            return
        life.walls = walls
        if walls.lacks:
            log.warning(
                "process lacks a wall", role=life.role, lacks=[_printable(lack) for lack in walls.lacks]
            )
        self._tell_processes()

    def _cannot_serve(self, life: Life, reason: str, output: Sequence[str]) -> None:
        """Before nodes may connect, it is for the person who starts the appliance; later the next life may succeed."""
        post = next(post for post in self.posts if post.life is life)
        life.reason = reason
        life.output = tuple(_printable(line)[:_LONGEST_LINE] for line in output[-OUTPUT_LINES:])
        if self.is_ready or post.role.dispensable:
            log.error("process cannot serve", role=life.role, reason=reason, output=list(life.output))
            life.kill()
        else:
            self.stop(reason)  # which says it, as the last line

    def control_said(self, life: Life, message: messages.Message, descriptors: tuple[int, ...]) -> None:
        """Carry out one message of control."""
        match message:
            case messages.SocketKept(name):
                self._keep(life, name, descriptors[0])
            case messages.SocketDropped(name):
                if name != ADMIN:
                    self.kept.drop(name)
            case messages.RouteWanted(host):
                self._answer(life, self._route(life, host))
            case messages.EndpointWanted():
                self._answer(life, self._tell_endpoint(life))
            case messages.TunnelsWanted(pool, address):
                self._answer(life, self._open_tunnels(life, pool, address))
            case messages.LogHeld(processes):
                self._free_log(processes)
            case messages.CompilerWanted():
                self._demand("compiler")
            case messages.ApplianceStopRequested(reason):
                log.warning("control asks to end the appliance", reason=reason)
                self.stop()

    def _free_log(self, processes: list[int]) -> None:
        """End readers of the audit log that hold what only its writer needs: none that is in order does.

        Where the kernel does not know who (-1), or names a process that is none of ours, all readers are ended.
        """
        ours = {post.life.pid for post in self.posts if post.life is not None}
        for post in self.posts:
            if _READERS not in {post.role.user, post.role.group} or post.life is None:
                continue
            if post.life.pid in processes or not ours.issuperset(processes):
                role, pid = post.role.name, post.life.pid
                log.critical("process is ended: the audit log is kept locked", role=role, pid=pid)
                post.life.kill()

    def _keep(self, life: Life, name: str, descriptor: int) -> None:
        if name == ADMIN:
            os.close(descriptor)
            self._violated(life, "sent a socket under the name of the admin socket")
            return
        try:
            self.kept.keep(name, descriptor)
        except RefusedSocketError as error:
            log.error("socket is not kept, a restart of control would lose it", reason=str(error))

    def _child_ready(self, life: Life, detail: dict[str, Any]) -> None:
        life.ready = True
        life.heard()
        if life.role == "relay":
            life.congestion = _printable(str(detail.get("congestion", "")))[:16]
            self._tell_processes()
        if life.role != "control":
            return
        try:
            said = msgspec.convert(detail, ControlReady)
        except msgspec.ValidationError as error:
            self._violated(life, f"said it is ready, but not where: {error}")
            return
        self._facts = replace(self._facts, rosout_master=said.rosout_master)
        self._spawn(self.control_ready(life, said))

    async def control_ready(self, life: Life, said: ControlReady) -> None:
        """Control serves: close off its inner ports, and announce it to whoever started the appliance."""
        reason = await self._guard.control_ready(said.inner_port, said.own_port)
        if reason is not None and not self.is_ready:
            self.stop(reason)
        if self.stopping.is_set() or not life.alive:
            return
        for post in self.posts:
            if post.role.after == life.role and post.is_vacant:
                self.fill(post)
        if not self.is_ready:
            try:
                self._ready(said)
            except StartError as error:
                self.stop(str(error))
                return
            self.is_ready = True
            life.send(messages.Announced())

    def _answer(self, life: Life, work: Coroutine[Any, Any, None]) -> None:
        """Work that ends with an answer to control, which may wait for many, but not for any number."""
        if self._unanswered >= _MOST_UNANSWERED:
            work.close()
            self._violated(life, f"asks for more than {_MOST_UNANSWERED} things at once")
            return
        self._unanswered += 1
        self._spawn(work).add_done_callback(self._answered)

    def _answered(self, _task: asyncio.Task[None]) -> None:
        self._unanswered -= 1

    async def _route(self, life: Life, host: str) -> None:
        life.send(messages.RouteFound(host, await self._guard.route_to(host)))

    async def _tell_endpoint(self, life: Life) -> None:
        life.send(await self._guard.endpoint())

    async def _open_tunnels(self, life: Life, pool: str, address: str) -> None:
        if not CHARON.exists():
            reason = f"{CHARON} is not there: apt install charon-systemd strongswan-swanctl libcharon-extra-plugins"
            life.send(messages.TunnelsEnclosed(None, reason))
            return
        answer = await self._guard.open_tunnels(pool, address)
        if answer.esp is not None:
            self._demand("charon")
        life.send(answer)

    def _demand(self, role: str) -> None:
        """Have a process that is there on demand; one that is just ending is followed by another."""
        for post in self.posts:
            if post.role.name == role:
                post.wanted = post.life is not None
                if post.is_vacant:
                    self.fill(post)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._finished)
        return task

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log_fault(task.get_loop(), {"message": "a task failed", "exception": error})

    def _violated(self, life: Life, what: str) -> None:
        log.critical("process is killed", role=life.role, pid=life.pid, reason=f"it {what}")
        life.kill()

    # --- watching -----------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        before = time.monotonic()
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            slept, before = now - before - 1.0, now
            for post in self.posts:
                if post.life is not None:
                    self._look_at(post, post.life, slept)
                if post.recovers():
                    self._tell_processes()
            clock = messages.ClockRead(clock_is_synchronised())
            if clock != self._clock:
                self._clock = clock
                self._tell_control(clock)

    def _look_at(self, post: Post, life: Life, slept: float) -> None:
        if slept > 1.0:
            life.forgive(slept)
        if post.role.asks:
            self._ask(life)
        elif life.is_program:
            return
        else:
            life.ping()
        if life.silent_too_long:
            log.error("process does not answer and is killed", role=life.role, pid=life.pid)
            life.kill()

    def _ask(self, life: Life) -> None:
        if self._asking is None or self._asking.done():
            self._asking = self._spawn(self._listen_to(life))

    async def _listen_to(self, life: Life) -> None:
        if await self.answers(2 * ANSWER_SECONDS):
            life.heard()

    async def answers(self, seconds: float) -> bool:
        """Whether ROSMaster answers within so many seconds."""
        inside = self._guard.enclosure.inside()
        return await rosmaster_probe.answers(self._facts.rosmaster_port, account_of("rosrv"), inside, seconds)

    def died(self, life: Life, code: int) -> None:
        """A process has ended: see who follows."""
        post = next(post for post in self.posts if post.life is life)
        lived = post.bury(life)
        self._someone_died.set()
        if self.stopping.is_set():
            return
        if post.role.on_demand and code == 0:
            self._ended(post)
            return
        log.error("process died", role=life.role, pid=life.pid, end=_end_of(code), lived=round(lived, 3))
        post.reason, post.output = life.reason or f"it ended with {_end_of(code)}", life.output
        self._tell_processes()
        if post.keeps_dying:
            if not self.is_ready:
                self.stop(f"{life.role} died {post.short_lives} times ({_end_of(code)}); the log says why")
                return
            log.critical(
                "process keeps dying", role=life.role, times=post.short_lives, reason=post.reason,
                again_in=post.delay(),
            )  # fmt: skip
        self._fill_later(post)

    def _ended(self, post: Post) -> None:
        """A process that was there on demand has ended by itself, as nobody needed it: that is no restart."""
        log.info("process ended", role=post.role.name)
        post.lives -= 1
        post.short_lives = 0
        self._tell_processes()
        if post.wanted:
            self.fill(post)

    def _fill_later(self, post: Post) -> None:
        post.due = asyncio.get_running_loop().call_later(post.delay(), self.fill, post)

    def _tell_processes(self) -> None:
        rows = [_about(post) for post in self.posts if post.life is not None or post.keeps_dying]
        own = messages.ProcessInfo("supervisor", os.getpid(), self._since, 0)
        self._tell_control(messages.ProcessesChanged([own, *rows]))

    def _tell_control(self, message: messages.Message) -> None:
        for post in self.posts:
            if post.role.name == "control" and post.life is not None:
                post.life.send(message)

    # --- ending -------------------------------------------------------------------------------------------

    async def _end(self) -> None:
        self.stopping.set()
        for task in self._tasks:
            task.cancel()
        await end_all(self.posts, self._someone_died)


def _log_fault(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    # A defect of ours in one callback must not take the robot's master away: it is shown, and the loop
    # goes on.
    log.critical("fault in the supervisor", fault=context["message"], exc_info=context.get("exception"))


def _about(post: Post) -> messages.ProcessInfo:
    """Return what control is told of a process that runs, or is to run again after it kept dying."""
    failing, output = (post.reason, list(post.output)) if post.keeps_dying else ("", [])
    life, restarts = post.life, post.lives - 1
    if life is None:
        return messages.ProcessInfo(post.role.name, 0, post.since, restarts, failing=failing, output=output)
    walls, lacks = life.enclosed
    return messages.ProcessInfo(
        post.role.name, life.pid, life.since, restarts, walls, lacks, life.congestion, failing, output
    )


def _printable(text: str) -> str:
    """Text that a terminal shows and does not obey; lines stay lines."""
    return "".join(
        character if character.isprintable() or character == "\n" else ascii(character)[1:-1]
        for character in text
    )


def _end_of(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
