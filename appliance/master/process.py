"""The control process: makes the parts, connects them, serves until told to stop.

Order of a start: kept sockets come back, the store and the policy are read, the audit log opens, the registry is
restored, the listeners serve, the first reconcile round makes ROSMaster whole, and only then `Ready` is said.
"""

import asyncio
import os
import re
import socket
import sys
import uuid
from pathlib import Path

import structlog
import uvloop

from appliance.audit.log import AuditLog
from appliance.audit.record import Severity
from appliance.audit.retention import Retention
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.config import Settings, load_resolved
from appliance.master.addresses import Addresses
from appliance.master.admin import AdminServer
from appliance.master.administration import Administration
from appliance.master.authority import Authority
from appliance.master.calls import MASTER_CALLS
from appliance.master.core import Master
from appliance.master.delivery import Delivery
from appliance.master.faces import Faces
from appliance.master.gate import Gate, HostLimits
from appliance.master.graph import Graph
from appliance.master.hosts import Hosts
from appliance.master.http import Handler, HttpLimits, HttpServer, Peer, Visitors, listen
from appliance.master.inner import InnerFace
from appliance.master.journal import StoreJournal, restore
from appliance.master.lifeline import ControlLifeline
from appliance.master.liveness import Liveness, LivenessSettings
from appliance.master.mediation import Mediation
from appliance.master.monitors import Monitors
from appliance.master.node_calls import NODE_CALLS
from appliance.master.parameters import ParameterMirror, Tree
from appliance.master.pipeline import Pipeline
from appliance.master.places import NoPortError, Places
from appliance.master.policies import Policies, PolicyRefusedError
from appliance.master.publisher import OwnPublisher
from appliance.master.reconcile import Reconciler
from appliance.master.recorder import Recorder
from appliance.master.registration import withdraw
from appliance.master.registry import Incarnation, Life, Registration, Registry
from appliance.master.relays import RelayControl
from appliance.master.reminders import Reminders
from appliance.master.rest import RestLink
from appliance.master.revocation import Revocation
from appliance.master.robot import own_address, robot_addresses
from appliance.master.rosmaster import RosMaster, limits_of_answers
from appliance.master.specifications import SpecificationsRefusedError
from appliance.master.tokens import Tokens
from appliance.master.turns import Turns
from appliance.ros.uris import node_uri
from appliance.ros.xmlrpc import Limits, build_fault
from appliance.store.database import StoreError
from appliance.store.state import StateStore

_log = structlog.get_logger()
_RVMASTER, _INNER, _OWN, _ADMIN = "rvmaster", "inner", "own", "admin"
_SAVE_SECONDS = 1.0


def main(lifeline_fd: int, config_path: Path) -> None:
    """Run control until the supervisor stops it."""
    settings = load_resolved(config_path)
    # The loop waits this long at most for a thread (audit log, store) that is in the middle of Python code.
    sys.setswitchinterval(0.0005)
    uvloop.run(_Control(settings, lifeline_fd).run())


class _Control:
    """The parts of control and the wires between them."""

    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        self._settings = settings
        self._home = settings.state / "control"
        self._lifeline = ControlLifeline(lifeline_fd)
        self._limits = Limits(
            body=int(settings.limits.body_bytes),
            elements=settings.limits.elements,
            depth=settings.limits.nesting,
            string=int(settings.limits.string_bytes),
            parts=settings.limits.multicall_parts,
        )
        self._http = HttpLimits(
            head_bytes=int(settings.limits.header_bytes),
            head_seconds=settings.limits.header_seconds,
            body_bytes=int(settings.limits.body_bytes),
            idle_seconds=settings.limits.idle_seconds,
            connections_per_host=settings.limits.connections_per_host,
            connections=settings.limits.connections,
        )
        self._visitors = Visitors(self._http)
        self._turns = Turns(self._http.slots, self._http.slots_per_host)
        self._stopping = asyncio.Event()
        self._signer: Channel | None = None
        self._servers: list[HttpServer] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._unhidden = ""
        self._params_dirty = asyncio.Event()

    async def run(self) -> None:
        """Serve from start to end; a start that fails is told to the supervisor."""
        self._loop = asyncio.get_running_loop()
        self._lifeline.stopped = self._stopping.set
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
        kept = self._lifeline.sockets
        restarted = _RVMASTER in kept
        self._make_records()
        await self._make_hosts()
        self._policies = Policies(
            self._settings.policy,
            self._store,
            self._recorder,
            robot=robot_addresses(self._settings),
            hosts=lambda: self._hosts.addresses,
        )
        self._policies.start(restarted=restarted)
        self._monitors = Monitors(
            self._settings.monitors,
            self._settings.enable,
            self._store,
            self._recorder,
            on_fault=self._settings.on_fault,
        )
        self._monitors.start(restarted=restarted)
        self._make_parts(self._take_sockets())
        await self._restore()
        await self._serve()
        self._lifeline.links["relay"] = self._relay_link
        self._lifeline.links["signer"] = self._signer_link
        self._lifeline.links["api"] = lambda descriptor: self._rest.attach(
            Channel(socket.socket(fileno=descriptor), messages.ApiLink, limit=16 << 20, longest=8 << 20)
        )
        self._lifeline.links["charon"] = lambda descriptor: self._hosts.attach(
            Channel(socket.socket(fileno=descriptor), messages.TunnelLink)
        )
        self._lifeline.probed = self._probed
        self._lifeline.processes_changed = self._reconciler.wake
        self._lifeline.reload_requested = self._reload_on_signal
        self._lifeline.open_links()
        for work in (
            self._reconciler.run(), self._liveness.run(), self._visitors.sweep(), self._save_parameters(),
            self._hosts.run(),
            self._publisher.run(self._reconciler.ready),
        ):  # fmt: skip
            self._tasks.append(self._loop.create_task(work))
        await self._reconciler.ready.wait()
        token = await self._tokens.first() if self._settings.api_address is not None else None
        self._say_ready(restarted, token)

    def _make_records(self) -> None:
        audit = self._settings.audit
        self._audit = AuditLog(
            self._home / "audit.db",
            durability=audit.durability,
            checkpoint_every=audit.checkpoint_records,
            checkpoint_seconds=audit.checkpoint_seconds,
            signer=self._want_signature,
            retention=Retention(
                days=audit.retention_days,
                size=None if audit.retention_bytes is None else int(audit.retention_bytes),
            ),
        )
        self._recorder = Recorder(
            self._audit,
            strict=audit.durability == "strict",
            deny_when_failed=audit.on_audit_failure == "deny",
        )
        self._store = StateStore(
            self._home, failed=lambda reason: _log.error("state is not written", reason=reason)
        )

    async def _make_hosts(self) -> None:
        """Before the policy, which names them: their addresses count once clear text is kept out."""
        self._authority = Authority()
        self._hosts = Hosts(
            self._store,
            self._recorder,
            self._authority,
            pool=self._settings.ipsec.pool,
            declared=self._settings.hosts,
            listen=self._settings.listen_address,
            say=self._lifeline.say,
        )
        self._lifeline.tunnels_enclosed = self._hosts.enclosed
        await self._hosts.start()

    def _take_sockets(self) -> dict[str, socket.socket]:
        host, port = self._settings.listen_address
        sockets = self._lifeline.sockets
        for name, address in (
            (_RVMASTER, (host, port)),
            (_INNER, ("127.0.0.1", 0)),
            (_OWN, ("127.0.0.1", 0)),
        ):
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

    def _make_parts(self, sockets: dict[str, socket.socket]) -> None:
        settings = self._settings
        host = settings.listen_address[0]
        self._port = sockets[_RVMASTER].getsockname()[1]
        inner_port = sockets[_INNER].getsockname()[1]
        registry = Registry(StoreJournal(self._store))
        self._places = Places(
            host, self._policies.current.ports, keep=self._lifeline.keep, drop=self._lifeline.drop
        )
        addresses = Addresses(
            [(one.network, one.address) for one in settings.advertise],
            self._lifeline.route_to if settings.isolation == "netns" else None,
        )
        self._delivery = Delivery(
            timeout=settings.limits.node_call_seconds, limits=self._limits, troubled=self._node_troubled
        )
        relay = RelayControl(
            registry, self._places, self._store, self._delivery, self._recorder, broken=self._look_at
        )
        mediation = Mediation(
            lambda: self._policies.current,
            lambda: self._monitors.checked,
            relay_all=settings.relaying == "all",
            stand_ins=settings.mediation == "full",
        )
        graph = Graph(
            registry,
            relay,
            self._delivery,
            self._recorder,
            mediation,
            closed=self._close_faces,
        )
        self._reminders = Reminders(registry, relay, graph)
        rosmaster = RosMaster(
            settings.rosmaster_port,
            lost=self._rosmaster_lost,
            limits=limits_of_answers(self._limits, int(settings.limits.parameter_bytes)),
        )
        self._faces = Faces(
            registry,
            self._places,
            inner_port=inner_port,
            serve=lambda one: self._pipeline.handler(NODE_CALLS, target=one),
            address_for=addresses.told_to,
            limits=self._http,
            visitors=self._visitors,
            turns=self._turns,
            refuse=self._refuse,
            troubled=self._peer_troubled,
            revive=self._revive,
            forget=graph.forgotten,
        )
        parameters = ParameterMirror(
            self._store.load_parameters(),
            self._params_dirty.set,
            bytes_limit=int(settings.limits.parameter_bytes),
            depth_limit=settings.limits.nesting,
        )
        self._reconciler = Reconciler(
            rosmaster,
            registry,
            self._faces,
            graph,
            parameters,
            self._recorder,
            own_parameters=_own_parameters,
        )
        self._liveness = Liveness(
            registry,
            graph,
            LivenessSettings(
                settings.liveness.interval,
                settings.liveness.silent,
                settings.liveness.shadow,
                settings.limits.node_call_seconds,
            ),
            self._limits,
            withdraw=self._withdraw,
            put_back=self._reconciler.put_back,
        )
        gate = Gate(
            lambda: self._policies.current,
            registry,
            HostLimits(settings.limits.nodes_per_host, settings.limits.topics_per_host),
            is_namespace=parameters.is_namespace,
        )
        self._master = Master(
            port=self._port,
            registry=registry,
            gate=gate,
            recorder=self._recorder,
            rosmaster=rosmaster,
            relay=relay,
            graph=graph,
            faces=self._faces,
            liveness=self._liveness,
            parameters=parameters,
            mediation=mediation,
            monitors=self._monitors,
            publish_as=settings.publish_as,
            hide_publisher=settings.hide_publisher,
            addresses=addresses,
            policy=lambda: self._policies.current,
            stop=lambda reason: self._lifeline.say(messages.ApplianceStopRequested(reason)),
        )
        self._monitors.send = relay.send
        relay.statement, relay.heard = self._monitors.statement, self._monitors.received
        self._publisher = OwnPublisher(
            self._master, settings.publish_as, inner_port, lambda: self._monitors.checked.publications
        )
        self._monitors.published = self._publisher.wake
        self._pipeline = Pipeline(
            self._master, limits=self._limits, offload=int(settings.limits.offload_bytes)
        )
        self._revocation = Revocation(self._master, put_back=self._reconciler.put_back)
        self._hosts.changed = self._policies.hosts_changed
        self._hosts.expel = self._revocation.expel
        self._policies.changed = lambda policy: self._policy_changed(policy.ports)
        self._inner = InnerFace(registry, self._delivery, self._limits)

    async def _restore(self) -> None:
        for name, sock in self._lifeline.sockets.items():
            if name.startswith("port:"):
                self._places.adopt(name, sock)
        restore(self._master.registry, self._store)
        self._master.relay.load()
        claimed: set[int] = set()
        for incarnation in self._master.registry.all():
            if incarnation.life is Life.REPLACED:
                continue
            try:
                await self._faces.reopen(incarnation)
            except NoPortError as error:
                _log.error("a node cannot be restored", node=incarnation.name, error=str(error))
                self._master.registry.forget(incarnation)
                continue
            claimed |= {incarnation.outer_port, incarnation.relay_port}
        self._places.close_unclaimed(claimed)

    async def _serve(self) -> None:
        sockets = self._lifeline.sockets
        await self._open(sockets[_RVMASTER], self._pipeline.handler(MASTER_CALLS), guarded=True)
        await self._open(sockets[_OWN], self._pipeline.handler(MASTER_CALLS, own=True), guarded=False)
        await self._open(sockets[_INNER], self._inner.handle, guarded=False)
        self._tokens = Tokens(self._store, self._recorder)
        administration = Administration(
            self._master,
            self._policies,
            self._tokens,
            self._store,
            self._lifeline.surroundings,
            hosts=self._hosts,
            lag=lambda: self._audit.lag,
            audit_failed=lambda: self._audit.failed,
            audit_degraded=lambda: self._audit.degraded,
            queued_deliveries=lambda: self._delivery.waiting,
        )
        self._rest = RestLink(administration, self._tokens, self._recorder)
        if _ADMIN in sockets:
            self._admin = AdminServer(administration)
            await self._admin.start(sockets[_ADMIN].dup())

    async def _open(self, sock: socket.socket, handler: Handler, *, guarded: bool) -> None:
        server = HttpServer(
            sock.dup(),
            handler,
            limits=self._http,
            visitors=self._visitors if guarded else Visitors(self._http),
            turns=self._turns if guarded else Turns(self._http.slots, self._http.slots),
            refuse=self._refuse if guarded else _refuse_nobody,
            troubled=self._peer_troubled,
        )
        self._servers.append(server)
        await server.start()

    def _say_ready(self, restarted: bool, token: str | None) -> None:
        host = self._settings.listen_address[0]
        told = own_address(self._settings) if host in {"0.0.0.0", "::"} else host  # noqa: S104 - compared only
        uri = node_uri(told, self._port)
        own = node_uri("127.0.0.1", self._lifeline.sockets[_OWN].getsockname()[1])
        inner_port = self._lifeline.sockets[_INNER].getsockname()[1]
        if not restarted:
            self._recorder.happened(
                "appliance started", f"nodes may connect at {uri}", severity=Severity.NOTICE
            )
        detail = {
            "master": uri.rstrip("/"),
            "revision": self._policies.revision,
            "rosout_master": own.rstrip("/"),
            "inner_port": inner_port,
            "token": token,
            "own_port": self._lifeline.sockets[_OWN].getsockname()[1],
        }
        self._lifeline.say(messages.Ready(detail))

    # --- end ---

    async def _end(self) -> None:
        for task in self._tasks:
            task.cancel()
        for server in self._servers:
            server.close()
        self._faces.close_all()
        self._reminders.close()
        self._delivery.close()
        self._master.rosmaster.close()
        self._recorder.happened(
            "appliance stopped", "control ended in an orderly way", severity=Severity.NOTICE
        )
        self._store.save_parameters(self._master.parameters.tree)
        self._store.close()
        self._audit.close()

    # --- wires ---

    def _refuse(self, peer: Peer) -> bytes | None:
        if self._unhidden:
            return build_fault(1, f"the appliance does not serve: {self._unhidden}")
        if self._policies.current.knows(peer.host):
            return None
        reason = f"no rule of the policy names {peer.text}"
        record = self._recorder.happened(
            "decision",
            reason,
            severity=Severity.WARNING,
            decision="deny",
            host=peer.text,
            category="command",
            resource="",
        )
        return build_fault(1, f"{reason} [{record}]")

    def _peer_troubled(self, peer: Peer, reason: str) -> None:
        self._recorder.happened(
            "limit exceeded", reason, severity=Severity.WARNING, decision="deny", host=peer.text
        )

    def _node_troubled(self, incarnation: Incarnation, why: str) -> None:
        _log.info("a node could not be told", node=incarnation.name, why=why)
        self._liveness.look_at(incarnation)

    def _close_faces(self, incarnation: Incarnation) -> None:
        self._faces.close(incarnation)

    def _look_at(self, incarnation: Incarnation) -> None:
        self._liveness.look_at(incarnation)

    async def _revive(self, incarnation: Incarnation) -> None:
        await self._liveness.revive(incarnation)

    def _rosmaster_lost(self) -> None:
        self._master.rosmaster.shut()
        self._reconciler.wake()

    async def _withdraw(self, incarnation: Incarnation, registrations: list[Registration]) -> None:
        for registration in registrations:
            await withdraw(self._master, incarnation, registration.kind, registration.resource)

    def _policy_changed(self, ports: range) -> int:
        self._places.set_range(ports)
        return self._revocation.redecide()

    def _reload_on_signal(self) -> None:
        try:
            self._policies.reload()
        except PolicyRefusedError as error:
            _log.error("the policy was refused, the last good one stays in force", findings=error.findings)

    def _probed(self, reason: str) -> None:
        if bool(reason) != bool(self._unhidden):
            event, severity = (
                ("probe failed", Severity.ALARM) if reason else ("probe passed", Severity.NOTICE)
            )
            self._recorder.happened(event, reason or "the ROS Master is hidden", severity=severity)
        self._unhidden = reason

    def _relay_link(self, descriptor: int) -> None:
        self._master.relay.attach(Channel(socket.socket(fileno=descriptor), messages.RelayLink))
        self._master.graph.tell_everybody()
        self._reminders.begin()

    def _signer_link(self, descriptor: int) -> None:
        channel = Channel(socket.socket(fileno=descriptor), messages.SignerLink)
        self._signer = channel
        self._authority.attach(channel)

        def received(message: object, _descriptors: tuple[int, ...]) -> None:
            if self._authority.received(message):
                return
            if isinstance(message, messages.SignatureMade):
                self._audit.signed(message.number, message.signature, message.public_key)
            elif isinstance(message, messages.SignatureRefused):
                self._audit.refused(message.number, message.reason)

        def closed() -> None:
            if self._signer is channel:
                self._signer = None
                self._authority.attach(None)

        channel.attach(self._loop, received, closed)
        self._audit.request_signatures()

    def _want_signature(self, number: int, text: bytes) -> None:
        """Called on the log's thread; unsigned checkpoints are asked for again when a signer appears."""

        def ask() -> None:
            if self._signer is not None:
                self._signer.send(messages.SignatureWanted(number, text))

        self._loop.call_soon_threadsafe(ask)

    async def _save_parameters(self) -> None:
        while True:
            await self._params_dirty.wait()
            self._params_dirty.clear()
            self._store.save_parameters(self._master.parameters.tree)
            await asyncio.sleep(_SAVE_SECONDS)


def _refuse_nobody(_peer: Peer) -> bytes | None:
    return None


def _own_parameters() -> Tree:
    """What `roscore` sets on a new ROSMaster."""
    tree: Tree = {"run_id": str(uuid.uuid1()), "rosdistro": os.environ.get("ROS_DISTRO", "Debian") + "\n"}
    try:
        text = Path("/usr/share/rosmaster/package.xml").read_text(encoding="utf-8")
    except OSError as error:
        _log.warning("the version of ROS is not known: /rosversion is not set", error=str(error))
        return tree
    version = re.search(r"<version>\s*([^<\s]+)", text)
    if version is not None:
        tree["rosversion"] = version[1] + "\n"
    return tree
