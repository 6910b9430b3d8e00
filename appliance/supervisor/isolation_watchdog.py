"""Check the isolation while the appliance runs, and report to control.

Each call runs in a daemon thread, so a call that hangs does not keep the appliance from ending. Every exception
becomes a finding, so an outdated good finding never hides a failure.

The kernel reports each change of rules in nftables (`watch`); they are restored at once, without waiting for other
work. The regular checks find what it does not report. Then connections that began without the rules are ended, more
than once: a peer may be late.
"""

import asyncio
import math
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from typing import TypeVar

import msgspec
import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.answers.status import FirewallState
from appliance.network.firewall.rule_watch import RuleWatch
from appliance.network.namespaces import NetworkError
from appliance.network.port_holders import PortsInUseError
from appliance.supervisor import signals
from appliance.supervisor.isolation_lifecycle import NoIsolation
from appliance.supervisor.machine_work import MachineWork, Terms

PROBE_SECONDS = 60.0
FORMER_SECONDS = 10.0
"""For so long, another machine cannot use a former address of this one: control may still count it as the robot's."""
REMOVED_SECONDS = 3600.0
"""For so long, the state shows that another program had removed rules."""
_REMEMBER_SECONDS = 1.0
_LATER_SECONDS = (0.5, 2.0)
_ROUTES_AT_ONCE = 4
_UNKNOWN = "the firewall may not be in force"

T = TypeVar("T")

log = structlog.get_logger()


class IsolationWatchdog:
    """Checks the isolation; `tell` sends a message to control, `record` also to one that starts later."""

    def __init__(
        self,
        isolation: NoIsolation,
        tell: Callable[[messages.Message], None],
        record: Callable[[messages.RulesRestored], None] | None = None,
        *,
        every: float = PROBE_SECONDS,
    ) -> None:
        self.isolation = isolation
        self._tell = tell
        self._record = record or tell
        self._every = every
        self._one_at_a_time = asyncio.Lock()
        self._few_at_a_time = asyncio.Semaphore(_ROUTES_AT_ONCE)  # route queries change nothing
        self._probe: messages.Message | None = None
        self._machine = isolation.trusted_machine
        self._taking_machine = False
        self._told_machine_at = -math.inf
        self._report = messages.FirewallReported(isolation=isolation.kind, report=FirewallState())
        self._changed = asyncio.Event()
        self._changes: list[tuple[float, str]] = []  # the times of changes, and their programs
        self._intact_at = clock.now()
        self._removed = -math.inf, ""
        self._unrestored = False  # whether the last restoration failed
        self._ending: set[asyncio.Task[object]] = set()

    def news(self) -> list[messages.Message]:
        return [self._report] if self._probe is None else [self._report, self._probe]

    def _reported(self, report: FirewallState) -> messages.FirewallReported:
        at, removed = self._removed
        recent = removed if clock.now() - at < REMOVED_SECONDS else ""
        shown = "; ".join(filter(None, (self.isolation.unprotected, recent)))
        report = msgspec.structs.replace(report, removed=shown or None)
        self._report = messages.FirewallReported(isolation=self.isolation.kind, report=report)
        return self._report

    def machine(self) -> messages.MachineAddresses:
        return messages.MachineAddresses(list(self._machine))

    def machine_has_changed(self) -> bool:
        return not self._taking_machine and self.isolation.machine_addresses() != self._machine

    async def take_machine(self) -> None:
        """Tell control the new addresses of the machine, while the firewall drops foreign packets with them.

        It drops those with former addresses too, until a later `look`.
        """
        self._taking_machine = True
        try:
            async with self._one_at_a_time:
                addresses = self.isolation.machine_addresses()
                await in_thread(lambda: self.isolation.trust_machine((*self._machine, *addresses)))
                self._machine = addresses
                self._tell(self.machine())
                self._told_machine_at = clock.now()
        except Exception as error:  # noqa: BLE001  see the invariant
            log.error("new addresses of the machine are not the robot's yet", error=_words(error))
            await asyncio.sleep(self._every)
        finally:
            self._taking_machine = False

    async def look(self) -> str | None:
        async with self._one_at_a_time:
            reason = await self._find_fault()
            await self._forget_former_machine()
        self._found(reason)
        return reason

    async def _forget_former_machine(self) -> None:
        if clock.now() - self._told_machine_at < FORMER_SECONDS:
            return
        try:
            await in_thread(lambda: self.isolation.trust_machine(self._machine))
        except Exception as error:  # noqa: BLE001  see the invariant
            log.error("former addresses of the machine stay closed to others", error=_words(error))

    def _found(self, reason: str | None) -> None:
        if reason is not None:
            log.critical("the appliance must not serve", reason=reason)
            self._probe = messages.ProbeFailed(reason)
        else:
            self._probe = messages.ProbePassed() if self.isolation.probes else None
        for message in self.news():
            self._tell(message)

    async def control_ready(self, inner_port: int, own_port: int) -> str | None:
        try:
            async with self._one_at_a_time:
                await in_thread(lambda: self.isolation.control_ready(inner_port, own_port))
        except PortsInUseError as error:
            self._found(str(error))
            return str(error)
        except Exception as error:  # noqa: BLE001  see the invariant
            reason = f"control's inner ports cannot be closed to others: {_words(error)}"
            self._found(reason)
            return reason
        return await self.look()

    async def open_tunnels(self, pool: str, address: str) -> messages.TunnelsEnclosed:
        try:
            async with self._one_at_a_time:
                esp = await in_thread(lambda: self.isolation.open_tunnels(pool, address))
                report = await in_thread(self.isolation.report)
        except Exception as error:  # noqa: BLE001  see the invariant
            return messages.TunnelsEnclosed(None, _words(error))
        self._tell(self._reported(report))
        log.info("addresses are taken through tunnels only", pool=pool, esp=esp)
        return messages.TunnelsEnclosed(esp)

    async def open_own_network(self, network: str, ports: list[int]) -> str:
        """Open the network, and return the reason for a failure, or an empty string."""
        try:
            async with self._one_at_a_time:
                await in_thread(lambda: self.isolation.open_own_network(network, ports))
                report = await in_thread(self.isolation.report)
        except Exception as error:  # noqa: BLE001  see the invariant
            return _words(error)
        self._tell(self._reported(report))
        return ""

    async def carry_out(
        self, work: MachineWork, number: int, name: str, terms: Terms
    ) -> messages.MachineWorkDone:
        try:
            async with self._one_at_a_time:
                found = await in_thread(lambda: self.isolation.carry_out(work, name, terms))
        except Exception as error:  # noqa: BLE001  see the invariant
            return messages.MachineWorkDone(number, {}, _words(error))
        return messages.MachineWorkDone(number, found)

    async def clear_tunnels(self, passive: Callable[[], bool]) -> None:
        try:
            async with self._one_at_a_time:
                if passive():
                    await in_thread(self.isolation.clear_tunnels)
        except Exception as error:  # noqa: BLE001  see the invariant
            log.error("tunnel state may remain", error=_words(error))

    async def route_to(self, host: str) -> str | None:
        try:
            async with self._few_at_a_time:
                return await in_thread(lambda: self.isolation.route_to(host))
        except Exception as error:  # noqa: BLE001  see the invariant
            log.warning("no route to a host", host=host, error=_words(error))
            return None

    async def endpoint(self) -> messages.EndpointFound:
        try:
            found = await in_thread(self.isolation.endpoint)
        except Exception as error:  # noqa: BLE001  see the invariant
            return messages.EndpointFound(None, _words(error))
        return messages.EndpointFound(found.address, found.reason)

    async def run(self) -> None:
        """Check regularly, and soon after a failure: it may be a short one, and refuses nodes until a check passes."""
        again, pause = _REMEMBER_SECONDS, self._every
        while True:
            await asyncio.sleep(pause)
            if await self.look() is None:
                again, pause = _REMEMBER_SECONDS, self._every
            else:
                again, pause = min(2 * again, self._every), again

    async def watch(self) -> None:
        """Restore rules as soon as the kernel reports that they have changed."""
        try:
            watches = await in_thread(self.isolation.watch_rules)
        except Exception as error:  # noqa: BLE001  see the invariant
            log.error("changes of the rules are found by the regular checks only", error=_words(error))
            return
        if not watches:
            return
        loop = asyncio.get_running_loop()
        for watch in watches:
            loop.add_reader(watch.fileno(), self._hear, watch)
        try:
            while True:
                try:
                    async with asyncio.timeout(_REMEMBER_SECONDS):
                        await self._changed.wait()
                except TimeoutError:
                    await self._remember()
                else:
                    self._changed.clear()
                    await self._restore()
        finally:
            for watch in watches:
                loop.remove_reader(watch.fileno())
                watch.close()

    def _hear(self, watch: RuleWatch) -> None:
        if programs := watch.changes():
            self._changes.append((clock.now(), programs[-1]))
            self._changed.set()

    async def _remember(self) -> None:
        if not self._ending:  # else a late connection would count as one of before
            with suppress(Exception):  # those of the last second are known
                await in_thread(self.isolation.remember_connections)

    async def _restore(self) -> None:
        """Install rules again that another program removed, and end the connections that began in the meantime."""
        changes, self._changes = self._changes, []
        try:
            missing, restored_at = await in_thread(self.isolation.restore)
        except Exception as error:  # noqa: BLE001  see the invariant
            self._changes, self._unrestored = changes + self._changes, True
            self._found(f"{_UNKNOWN}: {_words(error)}")
            await asyncio.sleep(_REMEMBER_SECONDS)
            self._changed.set()
            return
        if self._unrestored:  # the regular check comes late, and nodes are refused until a check passes
            self._unrestored = False
            self._begin(self.look())
        began, self._intact_at = self._intact_at, restored_at
        if missing:
            at, by = changes[0] if changes else (began, "")
            self._begin(self._restored(missing, by, self._intact_at - at, reported=bool(changes)))
            if (
                self.isolation.unprotected
            ):  # the failure may have been a short one: do not wait for the regular check
                asyncio.get_running_loop().call_later(_REMEMBER_SECONDS, self._changed.set)

    def _begin(self, work: Coroutine[None, None, object]) -> None:
        """Work while the rules are watched, or the next removal would wait for that."""
        task: asyncio.Task[object] = asyncio.create_task(work)
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    async def _restored(self, missing: list[str], by: str, seconds: float, *, reported: bool) -> None:
        log.critical("another program removed rules of the firewall, now in force again",
                     by=by, seconds=round(seconds, 3), rules=missing)  # fmt: skip
        at = self._intact_at
        ended = await self._end_once()
        self._begin(self._end_later())
        moment = clock.utc_now().isoformat(timespec="seconds")
        since = f"until {moment}, for {f'{seconds:.2g}' if reported else f'at most {math.ceil(seconds)}'} s"
        self._removed = at, (
            f"{by or 'another program'} removed {counted(len(missing), 'rule')} of the firewall {since}, now in"
            f" force again; {counted(ended, 'connection')} of that time ended. Other machines could reach the robot:"
            " let that program replace only its own tables (rosrv audit search --event 'firewall restored')"
        )  # fmt: skip
        self._record(messages.RulesRestored(missing, by, round(seconds, 3), reported, ended))
        self._tell(self._reported(self._report.report))

    async def _end_once(self) -> int:
        try:
            return await in_thread(self.isolation.end_connections)
        except Exception as error:  # noqa: BLE001  see the invariant
            log.error("connections that began without the rules may remain", error=_words(error))
            return 0

    async def _end_later(self) -> None:
        for seconds in _LATER_SECONDS:
            await asyncio.sleep(seconds)
            await self._end_once()

    async def _find_fault(self) -> str | None:
        try:
            await self._restore()
            self._reported(await in_thread(self.isolation.report))
            return await in_thread(self.isolation.probe)
        except Exception as error:  # noqa: BLE001  see the invariant
            return f"{_UNKNOWN}: {_words(error)}"


def _words(error: Exception) -> str:
    if isinstance(error, NetworkError | ValueError):
        return str(error)
    log.error("fault while checking the environment", exc_info=error)
    return f"{type(error).__name__}: {error}"


async def in_thread(function: Callable[[], T]) -> T:
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[T] = loop.create_future()

    def settle(answer: Callable[[], None]) -> None:
        if not outcome.done():
            answer()

    def work() -> None:
        signals.block()
        try:
            result = function()
        except BaseException as error:  # noqa: BLE001  handed to the caller, which waits for it
            answer = partial(outcome.set_exception, error)
        else:
            answer = partial(outcome.set_result, result)
        try:
            loop.call_soon_threadsafe(settle, answer)
        except RuntimeError:
            log.warning("finished after the appliance stopped", what=function.__qualname__)

    threading.Thread(target=work, name="guard", daemon=True).start()
    return await outcome
