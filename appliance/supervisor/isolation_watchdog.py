"""Looks after the enclosure while the appliance runs: probes it, keeps control informed of it.

What the enclosure does takes time, so each call is made in a thread, one after the other (a few that only look); the
supervisor's loop goes on meanwhile. The threads are daemons: one that hangs does not keep the appliance
from ending.

Invariant: whatever is raised on the way (no file, no process, no memory, an answer that cannot be read) is a
finding with its reason. It never ends the looking, and never leaves control with an older, better one.
"""

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import structlog

from appliance.channel import messages
from appliance.channel.answers.status import FirewallState
from appliance.network.namespaces import NetworkError
from appliance.supervisor import signals
from appliance.supervisor.isolation_lifecycle import Enclosure

PROBE_SECONDS = 60.0
_ROUTES_AT_ONCE = 4

T = TypeVar("T")

log = structlog.get_logger()


class Guard:
    """The enclosure as the supervisor sees it; `tell` gives a message to control."""

    def __init__(
        self, enclosure: Enclosure, tell: Callable[[messages.Message], None], *, every: float = PROBE_SECONDS
    ) -> None:
        self.enclosure = enclosure
        self._tell = tell
        self._every = every
        self._one_at_a_time = asyncio.Lock()
        self._few_at_a_time = asyncio.Semaphore(_ROUTES_AT_ONCE)  # routes are only looked up
        self._probe: messages.Message | None = None
        self._report = messages.FirewallReported(isolation=enclosure.kind, report=FirewallState())

    def news(self) -> list[messages.Message]:
        """What a new control has to know."""
        return [self._report] if self._probe is None else [self._report, self._probe]

    async def look(self) -> str | None:
        """Probe, look at the rules, tell control; the reason when something is open that must be hidden."""
        async with self._one_at_a_time:
            reason = await self._find_fault()
        self._found(reason)
        return reason

    def _found(self, reason: str | None) -> None:
        """Keep what was found, and tell control."""
        if reason is not None:
            log.critical("the appliance must not serve", reason=reason)
            self._probe = messages.ProbeFailed(reason)
        elif self.enclosure.probes:
            self._probe = messages.ProbePassed()
        for message in self.news():
            self._tell(message)

    async def control_ready(self, inner_port: int, own_port: int) -> str | None:
        """Close control's inner ports to others and look whether they are; the reason when not."""
        try:
            async with self._one_at_a_time:
                await in_thread(lambda: self.enclosure.control_ready(inner_port, own_port))
        except Exception as error:  # noqa: BLE001  see the invariant
            reason = f"control's inner ports cannot be closed to others: {_words(error)}"
            self._found(reason)
            return reason
        return await self.look()

    async def open_tunnels(self, pool: str, address: str) -> messages.TunnelsEnclosed:
        """Close a pool of addresses to clear text; where ESP runs, or why there can be no tunnels."""
        try:
            async with self._one_at_a_time:
                esp = await in_thread(lambda: self.enclosure.open_tunnels(pool, address))
                report = await in_thread(self.enclosure.report)
        except Exception as error:  # noqa: BLE001  see the invariant
            return messages.TunnelsEnclosed(None, _words(error))
        self._report = messages.FirewallReported(isolation=self.enclosure.kind, report=report)
        self._tell(self._report)
        log.info("addresses are taken through tunnels only", pool=pool, esp=esp)
        return messages.TunnelsEnclosed(esp)

    async def route_to(self, host: str) -> str | None:
        """The machine's address by which `host` reaches the appliance; None when its own route is right."""
        try:
            async with self._few_at_a_time:
                return await in_thread(lambda: self.enclosure.route_to(host))
        except Exception as error:  # noqa: BLE001  see the invariant
            log.warning("no route to a host", host=host, error=_words(error))
            return None

    async def endpoint(self) -> messages.EndpointFound:
        """Where hosts of other networks reach the appliance, or why that cannot be told."""
        try:
            found = await in_thread(self.enclosure.endpoint)
        except Exception as error:  # noqa: BLE001  see the invariant
            return messages.EndpointFound(None, _words(error))
        return messages.EndpointFound(found.address, found.reason)

    async def run(self) -> None:
        """Look every minute."""
        while True:
            await asyncio.sleep(self._every)
            await self.look()

    async def _find_fault(self) -> str | None:
        try:
            report = await in_thread(self.enclosure.report)
            self._report = messages.FirewallReported(isolation=self.enclosure.kind, report=report)
            return await in_thread(self.enclosure.probe)
        except Exception as error:  # noqa: BLE001  see the invariant
            return f"the state of the firewall cannot be told: {_words(error)}"


def _words(error: Exception) -> str:
    """What a person is told; what nobody thought of is shown whole in the log."""
    if isinstance(error, NetworkError | ValueError):
        return str(error)
    log.error("fault while looking at the surroundings", exc_info=error)
    return f"{type(error).__name__}: {error}"


async def in_thread(function: Callable[[], T]) -> T:
    """What `function` returns or raises, called in a daemon thread of its own."""
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[T] = loop.create_future()

    def settle(answer: Callable[[], None]) -> None:
        if not outcome.done():
            answer()

    def work() -> None:
        signals.block()
        try:
            result = function()
        except BaseException as error:  # noqa: BLE001  handed to the caller, who waits for it
            answer = partial(outcome.set_exception, error)
        else:
            answer = partial(outcome.set_result, result)
        try:
            loop.call_soon_threadsafe(settle, answer)
        except RuntimeError:
            log.warning("finished after the appliance had ended", what=function.__qualname__)

    threading.Thread(target=work, name="guard", daemon=True).start()
    return await outcome
