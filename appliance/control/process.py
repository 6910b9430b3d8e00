"""The control process: lays the foundation, has the parts assembled, serves until told to stop.

Order of a start: kept sockets come back, the store and the policy are read, the audit log opens, the registry is
restored, the listeners serve, the first reconcile round makes ROSMaster whole, and only then `Ready` is said. One file:
what is started here hears the supervisor here, and is ended here.
"""

import asyncio
import contextlib
import gc
import socket
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import structlog
import uvloop

from appliance.audit.budget import Budget
from appliance.audit.ids import IdSource
from appliance.audit.log import AuditLog
from appliance.audit.retention import Retention
from appliance.channel import messages
from appliance.channel.admin import HostsReload, PolicyReload
from appliance.channel.answers.status import AuditState, ProcessInfo
from appliance.channel.channel import Channel
from appliance.channel.messages.api import ApiLink
from appliance.configuration.settings import Settings, load_resolved
from appliance.control.admin_socket import AdminServer
from appliance.control.administration import Administration
from appliance.control.assembly import INNER, RVMASTER, Foundation, Parts
from appliance.control.clock_check import Clock
from appliance.control.evidence_orders import EvidenceOrders
from appliance.control.forwarder_link import Forwarded
from appliance.control.listener_limits import Doors
from appliance.control.policies import Policies, PolicyRefusedError, RevisionChangedError
from appliance.control.queries import Looks
from appliance.control.quota_class import HostStanding, charged_to
from appliance.control.rest import RestLink
from appliance.control.robot import master_address, robot_addresses
from appliance.control.signing import Signing
from appliance.control.spare_memory import SpareMemory
from appliance.control.supervisor_link import ControlLifeline
from appliance.control.switched_off import SwitchedOffWatch
from appliance.control.token_orders import Tokens
from appliance.hosts.certificate_requests import Authority
from appliance.hosts.certification import Certification
from appliance.hosts.enrolment import Hosts
from appliance.hosts.host_table import HostRefusedError, HostTable
from appliance.hosts.hosts_file import Declared
from appliance.hosts.rest_place import rest_place
from appliance.hosts.tunnel_address import find_endpoint
from appliance.hosts.tunnel_state import Tunnels
from appliance.master.endpoints.endpoint_addresses import NoPortError
from appliance.master.graph.registry import Life, Registry
from appliance.master.reconcile.enactor import restore
from appliance.quotas.pool import Standing
from appliance.quotas.table import AUDIT_RESERVE
from appliance.recorder.recording_plan import RecordingPlan
from appliance.rpc.server import listen
from appliance.specifications.allocation import TOPIC
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import node_uri

_log = structlog.get_logger()
_OWN, _ADMIN = "own", "admin"
_SWITCH_SECONDS = 0.0002
_GARBAGE = 10_000  # objects more than at the last look for garbage: records that wait for the log are none
_SAVE_SECONDS = 1.0
_TASKS_SECONDS = 0.4
_CLOSE_SECONDS = 1.2  # of the state, and of the log: in three seconds the supervisor ends who has not ended
_WARNINGS = 100  # of the policy, that a start tells
_RESERVED_SHARES = AUDIT_RESERVE.bounds.whole // AUDIT_RESERVE.bounds.host  # of a host, in the disk's reserve


def main(lifeline_fd: int, config_path: Path) -> None:
    """Run control until the supervisor stops it."""
    settings = load_resolved(config_path)
    # The loop waits no longer than this for a thread (audit log, store, large values) in the middle of Python code.
    sys.setswitchinterval(_SWITCH_SECONDS)
    gc.set_threshold(_GARBAGE)
    uvloop.run(_Control(settings, lifeline_fd).run())


class _Control:
    """The life of control: start, restore, serve, end."""

    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        self._settings = settings
        self._stopping = asyncio.Event()
        self._lifeline = ControlLifeline(
            lifeline_fd,
            self._stopping,
            lambda answer: self._tunnels.answered(answer),  # noqa: PLW0108 - made later
            lambda channel: self._compiler.attach(channel),  # noqa: PLW0108 - made below
        )
        self._compiler = SpecificationCompiler(lambda: self._lifeline.say(messages.CompilerWanted()))
        self._tasks: list[asyncio.Task[None]] = []
        self._parameters_dirty = asyncio.Event()
        self._reloading: set[asyncio.Task[None]] = set()
        self._one_reload = asyncio.Lock()
        self._failing: frozenset[str] = frozenset()  # the roles of processes that keep ending

    async def run(self) -> None:
        """Serve from start to end; a start that fails is told to the supervisor."""
        self._lifeline.attach()
        try:
            await self._start()
        except (PolicyRefusedError, SpecificationsRefusedError, StoreError, NoPortError, OSError) as error:
            self._lifeline.say(messages.Failed(str(error)))
            await self._stopping.wait()
            return
        await self._stopping.wait()
        await self._end()

    # --- start ---

    async def _start(self) -> None:
        await self._lifeline.restored.wait()
        if self._settings.monitors is not None:
            self._compiler.call()  # it starts while the policy is read
        restarted = RVMASTER in self._lifeline.sockets
        self._base = base = await self._lay_foundation(restarted)
        self._parts = Parts(base)
        await self._parts.monitors.start(restarted=restarted)
        self._hosts = self._make_hosts()
        await _restore(base, self._parts)
        await self._serve()
        self._lifeline.hear(self._heard)
        self._run_tasks()
        await self._parts.reconciler.ready.wait()
        token = await self._tokens.first() if self._settings.api_address is not None else None
        self._say_ready(restarted, token)

    async def _lay_foundation(self, restarted: bool) -> Foundation:
        self._signing = Signing(lambda: self._audit)
        self._authority = Authority(self._signing.link)
        self._standing: HostStanding | None = None
        self._audit = _open_audit(self._settings, self._signing, self._log_held(), self._standing_of)
        audit = self._settings.audit
        plan = RecordingPlan(
            self._settings.recorder, lambda host: charged_to(policies.current, host), IdSource().next
        )
        trail = AuditTrail(
            self._audit,
            strict=audit.durability == "strict",
            deny_when_failed=audit.on_audit_failure == "deny",
            recordings=plan.detail,
        )
        store = StateStore(
            self._settings.state / "control",
            failed=lambda reason: _log.error("state is not written", reason=reason),
        )
        # Before the policy, which names them: their addresses count once clear text is kept out.
        self._table = HostTable(store, self._settings.ipsec.pool, Declared(self._settings.hosts))
        self._tunnels = Tunnels(
            self._table, trail, self._authority, listen=self._settings.listen_address, say=self._lifeline.say
        )
        await self._tunnels.start()
        policies = Policies(
            self._settings.policy,
            store,
            trail,
            robot=robot_addresses(self._settings),
            hosts=lambda: self._tunnels.addresses,
            changed=lambda before, policy: self._parts.policy_changed(before, policy),  # noqa: PLW0108 - made later
            carried_out=lambda: self._parts.relay.carried_out(),  # noqa: PLW0108 - made later
            site_keys=self._settings.site_keys,
        )
        policies.start(restarted=restarted)
        registry = Registry()
        self._standing = standing = HostStanding(lambda: policies.current, registry.registrations_of)
        return Foundation(
            settings=self._settings,
            lifeline=self._lifeline,
            compiler=self._compiler,
            store=store,
            trail=trail,
            plan=plan,
            policies=policies,
            registry=registry,
            standing=standing,
            doors=Doors(self._settings, trail, lambda: policies.current, standing),
            sockets=self._take_sockets(),
            parameters_dirty=self._parameters_dirty,
        )

    def _standing_of(self, host: str) -> Standing:
        """What is known of a host; until the policy has been read nobody is a stranger."""
        return Standing.NAMED if self._standing is None else self._standing.of_text(host)

    def _make_hosts(self) -> Hosts:
        self._certification = Certification(
            self._base.store,
            self._base.trail,
            self._authority,
            self._table,
            self._tunnels,
            master_port=self._settings.listen_address[1],
            rest=rest_place(self._settings),
            changed=self._base.policies.hosts_changed,
        )
        return Hosts(
            self._certification,
            partial(find_endpoint, self._settings, self._lifeline.endpoint),
            expel=self._parts.expel,
            carried_out=self._parts.relay.carried_out,
            machines=self._parts.machines,
        )

    def _take_sockets(self) -> dict[str, socket.socket]:
        host, port = self._settings.listen_address
        sockets = self._lifeline.sockets
        for name, address in ((RVMASTER, (host, port)), (INNER, ("127.0.0.1", 0)), (_OWN, ("127.0.0.1", 0))):
            if name not in sockets:
                try:
                    sockets[name] = listen(*address)
                except OSError as error:
                    raise OSError(
                        f"{address[0]}:{address[1]} cannot be listened on: {error.strerror}; "
                        "is a ROS Master running there? Stop it, or choose another --listen"
                    ) from error
                self._lifeline.keep(name, sockets[name])
        return sockets

    async def _serve(self) -> None:
        base, parts, sockets = self._base, self._parts, self._base.sockets
        doors = base.doors
        await doors.open(sockets[RVMASTER], parts.pipeline.handler(parts.table), guarded=True)
        await doors.open(sockets[_OWN], parts.pipeline.handler(parts.table, own=True), guarded=False)
        # ROSMaster asks the kernel about every connection that it keeps, at each call that it makes.
        inner = parts.inner
        await doors.open(sockets[INNER], inner.handle, guarded=False, at_once=inner.acknowledge, keep=False)
        self._tokens = Tokens(base.store, base.trail, lambda: self._rest.state_tokens())  # noqa: PLW0108 - made below
        if self._lifeline.announced:
            self._tokens.told()
        self._clock = Clock(base.trail, lambda: self._audit.ids.ahead)
        self._forwarded = Forwarded(self._settings.audit.syslog, base.trail)
        self._switched_off = SwitchedOffWatch(
            parts.monitors, base.policies, base.store, base.trail, self._settings.forgotten_after
        )
        looks = Looks(
            parts,
            base.policies,
            self._hosts,
            self._lifeline.surroundings,
            audit=self._audit_state,
            clock=self._clock.state,
            recorder=parts.recordings.state,
            queued_deliveries=lambda: parts.delivery.waiting,
            live=parts.revocation.live,
            switched_off=self._switched_off.rows,
        )
        administration = Administration(
            looks,
            base.policies,
            parts.monitors,
            self._hosts,
            self._hosts.itself,
            self._hosts.ports,
            self._certification,
            self._tokens,
            parts.recordings,
            EvidenceOrders(self._audit, base.trail),
            durable=base.trail.durable,
            require_room=base.store.database.require_room,
        )
        self._rest = RestLink(
            administration,
            self._tokens,
            base.trail,
            served=self._certification.served_by,
            require_proof=self._settings.api_require_proof,
        )
        if _ADMIN in sockets:
            # Held: a server that nobody holds is closed.
            self._admin = await AdminServer(administration).start(sockets[_ADMIN].dup())

    def _audit_state(self) -> AuditState:
        assert self._forwarded is not None  # noqa: S101  it is asked when all is there
        return AuditState(
            *self._audit.lag,
            failed=self._audit.failed,
            on_failure=self._settings.audit.on_audit_failure,
            degraded=self._audit.degraded,
            forwarding=self._forwarded.status(),
        )

    def _run_tasks(self) -> None:
        base, parts = self._base, self._parts
        for work in (
            parts.reconciler.run(),
            parts.liveness.run(),
            base.doors.sweep(),
            SpareMemory().watch(),
            self._clock.watch(),
            self._switched_off.watch(),
            self._save_parameters(),
            self._tunnels.run(self._certification.each_hour),
            parts.publisher.run(parts.reconciler.ready),
        ):
            self._tasks.append(asyncio.get_running_loop().create_task(work))

    def _log_held(self) -> Callable[[list[int]], None]:
        """Tells the supervisor, from the log's thread, who keeps the log locked."""
        loop, say = asyncio.get_running_loop(), self._lifeline.say

        def tell(processes: list[int]) -> None:
            with contextlib.suppress(RuntimeError):  # it has ended
                loop.call_soon_threadsafe(say, messages.LogHeld(processes))

        return tell

    def _say_ready(self, restarted: bool, token: str | None) -> None:
        host, base = self._settings.listen_address[0], self._base
        told = master_address(self._settings) if host in {"0.0.0.0", "::"} else host  # noqa: S104 - compared only
        uri = node_uri(told, base.port(RVMASTER))
        self._lifeline.surroundings.master = uri.rstrip("/")
        if not restarted:
            base.trail.happened("appliance started", f"nodes may connect at {uri}")
        detail = {
            "master": uri.rstrip("/"),
            "revision": base.policies.revision,
            "rosout_master": node_uri("127.0.0.1", base.port(_OWN)).rstrip("/"),
            "inner_port": base.port(INNER),
            "token": token,
            "own_port": base.port(_OWN),
            "warnings": [str(warning) for warning in base.policies.current.warnings[:_WARNINGS]],
        }
        self._lifeline.say(messages.Ready(detail))

    # --- end ---

    async def _end(self) -> None:
        base, parts = self._base, self._parts
        base.doors.close()
        parts.faces.close_all()
        parts.reminders.close()
        parts.delivery.close()
        parts.rosmaster.close()
        await _end_others(_TASKS_SECONDS)  # requests write state, also while they end
        base.trail.happened("appliance stopped", "control ended in an orderly way")
        base.store.save_parameters(parts.parameters.tree)
        base.store.close(_CLOSE_SECONDS)
        unwritten = self._audit.close(_CLOSE_SECONDS)
        if unwritten is not None:
            _log.error("the last records of the audit log are not written", reason=unwritten)

    # --- what the supervisor says ---

    def _heard(self, message: Any, descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.LinkOpened(role, index):
                self._link(role, index, socket.socket(fileno=descriptors[0]))
            case messages.ProcessesChanged(processes):
                self._note_failing(processes)
                self._parts.reconciler.wake()
            case messages.PolicyReloadRequested():
                self._reload_on_signal()
            case messages.Announced():
                self._tokens.told()
            case messages.ClockRead(synchronised):
                self._clock.told(synchronised)
            case messages.ProbeFailed(reason):
                self._base.doors.probed(reason)
            case messages.ProbePassed():
                self._base.doors.probed("")
            case _:
                _log.error(
                    "the supervisor said something that is not for control", message=type(message).__name__
                )

    def _note_failing(self, processes: list[ProcessInfo]) -> None:
        """Record each process that has come to end soon after every start."""
        failing = {process.role: process for process in processes if process.failing}
        for role in failing.keys() - self._failing:
            process = failing[role]
            restarts, output = process.restarts, process.output
            self._base.trail.happened(
                "process failing",
                f"{role}: {process.failing}",
                resource=role,
                restarts=restarts,
                output=output,
            )
        self._failing = frozenset(failing)

    def _link(self, role: str, index: int, sock: socket.socket) -> None:
        """To another process."""
        match role:
            case "relay":
                self._relay_link(index, Channel(sock, messages.RelayLink))
            case "signer":
                self._signing.attach(Channel(sock, messages.SignerLink))
            case "api":
                self._rest.attach(Channel(sock, ApiLink, limit=16 << 20, longest=8 << 20))
            case "charon":
                self._tunnels.attach(Channel(sock, messages.TunnelLink))
            case "syslog":
                self._forwarded.link.attach(Channel(sock, messages.ForwardingLink))
            case "recorder":
                self._parts.recordings.link.attach(Channel(sock, messages.RecorderLink))
            case _:
                _log.error("a link leads to a process that control does not know", role=role)
                sock.close()

    def _reload_on_signal(self) -> None:
        task = asyncio.get_running_loop().create_task(self._reload())
        self._reloading.add(task)  # held until it is done
        task.add_done_callback(self._reloading.discard)

    async def _reload(self) -> None:
        async with self._one_reload:
            try:
                await _reload_policy(self._base.policies)
            except PolicyRefusedError as error:
                _log.error(
                    "the policy was refused, the last good one stays in force", findings=error.findings
                )
            except StoreError as error:
                _log.error("the policy is in force and not kept", reason=str(error))
            await self._reload_hosts()

    async def _reload_hosts(self) -> None:
        try:
            await self._hosts.reload(HostsReload(), "disk")
        except HostRefusedError as error:
            _log.error("hosts.yaml was refused", reason=str(error))
        except StoreError as error:
            _log.error("hosts.yaml is in force and not kept", reason=str(error))

    def _relay_link(self, index: int, channel: Channel) -> None:
        relay = self._parts.relay
        relay.attach(index, channel)
        told = self._parts.graph.tell_everybody(lambda topic: relay.carries(index, TOPIC, topic))
        self._parts.enactor.carry_out(told)
        self._parts.reminders.begin()

    async def _save_parameters(self) -> None:
        while True:
            await self._parameters_dirty.wait()
            self._parameters_dirty.clear()
            self._base.store.save_parameters(self._parts.parameters.tree)
            await asyncio.sleep(_SAVE_SECONDS)


async def _end_others(seconds: float) -> None:
    """Cancel every other task, and wait so long at most until they have ended."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    if others:
        await asyncio.wait(others, timeout=seconds)


async def _reload_policy(policies: Policies) -> None:
    """The file as it is now, also when another revision comes into force meanwhile. Raises `PolicyRefusedError`."""
    while True:
        try:
            await policies.reload(PolicyReload(), "disk")
        except RevisionChangedError:
            continue
        return


def _open_audit(
    settings: Settings,
    signing: Signing,
    held_by: Callable[[list[int]], None],
    standing: Callable[[str], Standing],
) -> AuditLog:
    audit = settings.audit
    reserve = AUDIT_RESERVE.bounds.sized(
        int(audit.reserve_bytes), int(audit.reserve_bytes) // _RESERVED_SHARES
    )
    return AuditLog(
        settings.state / "control" / "audit.db",
        durability=audit.durability,
        checkpoint_every=audit.checkpoint_records,
        checkpoint_seconds=audit.checkpoint_seconds,
        signer=signing.want,
        removals=signing.want_removal,
        held_by=held_by,
        budget=Budget(standing, reserve=reserve),
        reserve=reserve.whole,
        retention=Retention(
            days=audit.retention_days,
            size=None if audit.retention_bytes is None else int(audit.retention_bytes),
        ),
    )


async def _restore(base: Foundation, parts: Parts) -> None:
    """Bring back the nodes of before a restart, with their ports and grants, as far as the policy allows."""
    registry, places, enactor = parts.registry, parts.places, parts.enactor
    for name, sock in base.sockets.items():
        if name.startswith("port:"):
            places.adopt(name, sock)
    restore(registry, base.store)
    enactor.carry_out(parts.grants.restore(base.store.permissions()))
    claimed: set[int] = set()
    for incarnation in registry.all():
        if incarnation.life is Life.REPLACED:
            continue
        try:
            enactor.carry_out(await parts.faces.reopen(incarnation))
        except NoPortError as error:
            _log.error("a node cannot be restored", node=incarnation.name, error=str(error))
            enactor.carry_out(registry.forget(incarnation))
            continue
        claimed |= set(incarnation.ports)
    places.close_unclaimed(claimed)
    # The file was changed while the appliance was down, or control died while it carried out a change.
    parts.policy_changed(base.policies.current, base.policies.current)
