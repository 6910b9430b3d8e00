"""Handle the messages of the supervisor while control serves."""

import asyncio
import socket
from collections.abc import Coroutine

import structlog

from appliance.base.actors import DISK
from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.admin import PolicyReload
from appliance.channel.answers.status import ProcessInfo
from appliance.channel.channel import Channel
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import Foundation
from appliance.control.assembly.policies import RevisionChangedError
from appliance.control.errors import PolicyRefusedError
from appliance.control.operator_assembly import Operators
from appliance.hosts.host_table import HostRefusedError
from appliance.master.graph.registry import Kind
from appliance.specifications.allocation import TOPIC
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

_RELAY_BACKLOG = 128 << 20  # bytes; changes of the graph use half of it

_log = structlog.get_logger()


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
        f"{message.by or 'another program'} removed {counted(len(message.rules), 'rule')} of the firewall, which are in"
        f" force again after {span}; {counted(message.connections, 'connection')} of that time ended",
        seconds=message.seconds,
        by=message.by or None,
        rules=message.rules,
        connections=message.connections,
    )


class SupervisorMessages:
    """Passes the supervisor's links and reports to the parts of control."""

    def __init__(self, base: Foundation, parts: Parts, operators: Operators) -> None:
        self._base = base
        self._parts = parts
        self._operators = operators
        self._tasks: set[asyncio.Task[None]] = set()
        self._one_reload = asyncio.Lock()
        self._failing: frozenset[str] = frozenset()  # the roles of processes that keep ending

    def heard(self, message: object, descriptors: tuple[int, ...]) -> None:  # noqa: PLR0912  a case for each message
        match message:
            case messages.LinkOpened(role, index):
                self._link(role, index, socket.socket(fileno=descriptors[0]))
            case messages.ProcessesChanged(processes):
                self._note_failing(processes)
                self._parts.reconciler.wake()
            case messages.ProcessDied():
                record_death(self._base.trail, message)
            case messages.PolicyReloadRequested():
                self._spawn(self._reload())
            case messages.EndAnnounced():
                self._spawn(self._agree_to_end())
            case messages.Announced():
                self._operators.tokens.first_token_shown()
            case messages.ClockRead(synchronised):
                self._operators.clock.synchronisation_reported(synchronised)
            case messages.MachineAddresses(addresses):
                _log.info("addresses of the robot's machine", addresses=addresses)
                self._parts.endpoints.addresses.forget_routes()
                self._base.policies.hosts_changed()
            case messages.RulesRestored():
                record_removal(self._base.trail, message)
                for work in self._base.lifeline.surroundings.after_removal:
                    work()
            case messages.ProbeFailed(reason):
                self._base.listener_limits.probed(reason)
            case messages.ProbePassed():
                self._base.listener_limits.probed("")
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
            await self._base.lifeline.finish()
        finally:
            self._base.lifeline.say(messages.EndAgreed())

    def _note_failing(self, processes: list[ProcessInfo]) -> None:
        failing = {process.role: process for process in processes if process.failing}
        for role in failing.keys() - self._failing:
            process = failing[role]
            self._base.trail.happened(
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
                self._base.signing.attach(Channel(sock, messages.SignerLink))
            case "api":
                self._operators.rest.attach(self._base.lifeline.api_channel(sock.detach()))
            case "charon":
                self._base.hosts.tunnels.attach(Channel(sock, messages.TunnelLink))
            case _:
                self._feature_link(role, index, sock)

    def _feature_link(self, role: str, index: int, sock: socket.socket) -> None:
        attached = self._operators.links.of(role, index)
        if attached is None:
            _log.error("a link leads to a process unknown to control", role=role)
            sock.close()
            return
        link, accepted, longest = attached
        link.attach(Channel(sock, accepted, longest=longest))

    def _relay_link(self, index: int, channel: Channel) -> None:
        ends, subscribers = self._parts.endpoints, self._parts.endpoints.subscribers
        ends.relay.attach(index, channel)

        def carried(topic: str) -> bool:
            return ends.relay.allocation.of(TOPIC, topic) == index

        if self._base.role.took_over:
            # Every connection ended, and roscpp may have given up: subscribers drop all publishers first.
            for kind, topic, _holders in list(self._parts.core.registry.resources()):
                if kind is Kind.SUBSCRIPTION and carried(topic):
                    subscribers.renew_all(topic)
        subscribers.remind_all(carried)
        self._parts.reminders.begin()

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
                await self._base.hosts.enrolment.read_again(DISK)
            except HostRefusedError as error:
                _log.error("hosts.yaml was rejected", reason=str(error))
            except StoreError as error:
                _log.error("hosts.yaml is in force and not stored", reason=str(error))

    async def _reload_policy(self) -> None:
        while True:
            try:
                await self._base.policies.reload(PolicyReload(), DISK)
            except RevisionChangedError:  # another revision came into force in the meantime
                continue
            return
