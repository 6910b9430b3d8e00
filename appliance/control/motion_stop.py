"""Stop the robot after a host lost the right to command it: the guards of its topics send their safe messages."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from functools import partial

from appliance.control.core import Core
from appliance.master.graph.registry import Kind
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_READY_SECONDS = 0.1

StopAfter = Callable[[str, Iterable[str], str], Awaitable[None]]
"""Stops the topics that a host commanded, and gives the reason, as `MotionStop.after` does."""

Commands = set[tuple[str, str]]
"""Hosts, each with a topic that it published."""


def published_before(store: StateStore, concerns: Callable[[Address, str], bool]) -> Commands:
    nodes, registrations = store.load_registry()
    hosts = {node.key: node.host for node in nodes if not node.own}
    return {
        (host, registration.resource)
        for registration in registrations
        if registration.kind == Kind.PUBLICATION and (host := hosts.get(registration.key)) is not None
        if concerns(address_of(host), registration.resource)
    }


@dataclass(frozen=True, slots=True)
class MotionStop:
    """Stops the robot; `stop(topic)` returns the names of the monitors that do it, or None if no relay answers."""

    stop: Callable[[str], Awaitable[list[str] | None]]
    trail: AuditTrail
    policy: Callable[[], Policy]

    async def after(self, host: str, topics: Iterable[str], why: str) -> None:
        """Stop the topics that this host commanded, and record the stop even if no guard carries it out.

        A topic without a guard needs no stop unless it is in a group of `[Authority]`.
        """
        wanted = sorted(topics)
        begun = dict(zip(wanted, await asyncio.gather(*map(self.stop, wanted)), strict=True))
        stopped = {topic: monitors for topic, monitors in begun.items() if monitors}
        if unknown := [topic for topic, monitors in begun.items() if monitors is None]:
            text = f"the relay of {', '.join(unknown)} does not answer, so its guards may not stop the robot: {why}"
            self._record("motion not stopped", text, host, unknown)
        if stopped:
            sent = "; ".join(f"{', '.join(names)} on {topic}" for topic, names in stopped.items())
            self._record("motion stopped", f"safe messages of {sent}: {why}", host, stopped)
        elif commanded := [
            topic
            for topic, monitors in begun.items()
            if monitors is not None and self.policy().command_group(topic) is not None
        ]:
            text = f"no enabled guard has a safe message for {', '.join(commanded)}, so nothing stops the robot: {why}"
            self._record("motion not stopped", text, host, commanded)

    def of_published_before(
        self, core: Core, wanted: Callable[[], bool], concerns: Callable[[Address, str], bool]
    ) -> Callable[[], Awaitable[None]]:
        """Return the work that stops the topics of earlier publishers, if the first policy wants it.

        `concerns(host, topic)` decides at the first policy, and again when the relays have reported what they kept.
        """
        lost: Commands = set()

        def find() -> None:
            if wanted():
                lost.update(published_before(core.store, concerns))

        core.policy.on_first(find)
        return partial(self.at_start, lost, core.relay.ready, core.relay.carried_out, concerns)

    async def at_start(
        self,
        lost: Commands,
        ready: Callable[[], bool],
        carried_out: Callable[[], Awaitable[None]],
        concerns: Callable[[Address, str], bool],
    ) -> None:
        """Stop topics whose hosts lost the right while control was away, once no relay serves these hosts."""
        while lost and not ready():
            await asyncio.sleep(_READY_SECONDS)
        await carried_out()
        while lost:
            host, topic = lost.pop()
            if concerns(address_of(host), topic):
                await self.after(
                    host, {topic}, "RVMaster started again, and the right of the host is not kept"
                )

    def _record(self, event: str, reason: str, host: str, topics: Iterable[str]) -> None:
        self.trail.happened(event, reason, host=host, resource=next(iter(topics)), whole=True)
