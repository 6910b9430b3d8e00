"""Run the appliance: prepare everything before the first process starts, and clean up after the last."""

import asyncio
import contextlib
import json
import math
import os
import signal
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import TypeVar

import setproctitle
import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.configuration.config_sources import plain
from appliance.configuration.settings import Settings, Unasked
from appliance.features.table import machine_work_in
from appliance.network.boot_hold import BootHold, HeldPorts, starts_again
from appliance.network.close_ports import local_port_range
from appliance.network.firewall.firewall_rules import Family, PeerAccess, family_of
from appliance.network.firewall.iptables import load_modules
from appliance.network.namespaces import Namespace, NetworkError, has_privileges
from appliance.supervisor import signals
from appliance.supervisor.errors import PortInUseError, StartError
from appliance.supervisor.heartbeat_wiring import HeartbeatWiring
from appliance.supervisor.isolation_lifecycle import AppliancePorts, NoIsolation, isolation_for
from appliance.supervisor.lapse_answers import answer_for_control
from appliance.supervisor.monitor_memory import MonitorMemory
from appliance.supervisor.port_check import free_port, require_free, spare_ports
from appliance.supervisor.privileges import drop_unused_capabilities, raise_file_limit, raise_priority
from appliance.supervisor.restore_mark import refuse_half_restored
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.roles import memories
from appliance.supervisor.sandbox.private_view import (
    program_folders,
    require_view,
    view_of,
)
from appliance.supervisor.service_gate import Pairing, ServiceGate
from appliance.supervisor.service_manager import ServiceManager
from appliance.supervisor.state_directory import StateDirectory
from appliance.supervisor.supervisor import ControlReady, Supervisor

# Wait while another program holds a port of the appliance, such as a ROS master that the robot started first.
#
# Without this wait, the service would end before that program does, and the robot would run on without the appliance.
# The status of the service, the log and `rosrv status` give the reason. A person at a terminal gets it as an error.

_PORT_LOOK_SECONDS = 2.0
_SAY_SECONDS = 600.0  # between two equal lines of the log

T = TypeVar("T")


def built_when_free(build: Callable[[], T], manager: ServiceManager, admin: socket.socket) -> T | None:
    """Call `build` until it raises no `PortInUseError`; return its result, or None if a signal ended the wait.

    The requests on the admin socket get the reason. Signals are held while `build` runs.
    """
    try:
        return build()
    except PortInUseError as error:
        reason = str(error)
    return asyncio.run(_build_later(build, reason, manager, admin))


async def _build_later(
    build: Callable[[], T], reason: str, manager: ServiceManager, admin: socket.socket
) -> T | None:
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)
    loop.add_signal_handler(signal.SIGHUP, lambda: None)  # the policy is read when it starts
    async with manager.watch():
        while True:
            try:
                async with _said(f"waits: {reason}", manager, admin):
                    return await _retry(build, reason, stopped)
            except PortInUseError as error:
                reason = str(error)


async def _retry(build: Callable[[], T], reason: str, stopped: asyncio.Event) -> T | None:
    """Return what `build` returns, or None if `stopped` is set. Raises `PortInUseError` for another reason."""
    began = clock.now()
    while True:
        with signals.hear(), contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_PORT_LOOK_SECONDS):
                await stopped.wait()
        for _ in range(3):  # let the loop deliver a signal of the last moment
            await asyncio.sleep(0)
        if stopped.is_set():
            return None
        try:
            return build()
        except PortInUseError as error:
            if str(error) != reason or clock.now() - began > _SAY_SECONDS:
                raise


@contextlib.asynccontextmanager
async def _said(reason: str, manager: ServiceManager, admin: socket.socket) -> AsyncIterator[None]:
    log.error(reason)
    manager.starting(reason)
    answers = asyncio.create_task(answer_for_control(admin.dup, reason))
    try:
        yield
    finally:
        answers.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await answers


# Put, lift and arm the boot hold around a run of the appliance. A hold that fails is logged, and ends nothing.

_LOOK_SECONDS = 5.0
_KEEP_SECONDS = 0.5


class HoldAround:
    """The boot hold of the service; `used`: this is the service of a single appliance."""

    def __init__(self, settings: Settings, *, used: bool, link: str, hold: BootHold | None = None) -> None:
        self._hold = hold or BootHold(Namespace.own())
        self._ports: HeldPorts | None = None
        self._looked_at = -math.inf
        self._removed = 0
        self._served: str | None = None
        self._arms = True  # at the last `lift_hold`
        if (
            used
            and settings.isolation != "none"
            and settings.firewall.hold != "off"
            and self._hold.is_present
        ):
            nodes = local_port_range()
            own = settings.firewall.hold_seconds if settings.firewall.hold == "own" else None
            self._ports = HeldPorts(settings.listen_address[1], nodes.first, nodes.last, link, own)

    def put(self) -> None:
        if self._ports is not None:
            self._looked_at = clock.now()
            try:
                if self._hold.put():
                    self._removed += 1
                    log.critical("another program removed the boot hold: it is in force again")
            except (NetworkError, OSError) as error:
                log.error(
                    "other machines are not held off while the appliance does not serve", error=str(error)
                )

    def put_before_restart(self) -> None:
        """Hold other machines off the master before an ordered restart gives the robot's graph back to its own one."""
        if self._ports is not None and starts_again():
            try:
                self._hold.put(nodes=False)
            except (NetworkError, OSError) as error:
                log.error("other machines reach the robot's own master until the restart", error=str(error))

    def keep(self) -> None:
        """Restore the hold if another program has removed its rules; looks every five seconds at most."""
        if self._ports is not None and clock.now() - self._looked_at >= _LOOK_SECONDS:
            self._looked_at = clock.now()
            if not self._hold.is_intact():
                self.put()

    @property
    def held_off(self) -> str:
        """Return what a wait for a port means for other machines; "" if they are not held off."""
        if self._ports is None or not self._hold.is_in_force:
            return ""
        return "; other machines are held off until the appliance serves, or until `sudo rosrv release`"

    async def until(
        self, is_open: Callable[[], bool], is_released: Callable[[], bool] = lambda: False
    ) -> str:
        """Keep the hold until other machines reach the appliance, and not the robot's own master, or until that is
        released; see `lift_hold`.
        """
        while not is_open():
            self.keep()
            await asyncio.sleep(_KEEP_SECONDS)
        return self.lift_hold(arms=not is_released())

    def lift_hold(self, *, arms: bool = True) -> str:
        """Lift and arm the hold, once; without `arms`, for a robot that was released, disarm it.

        Return an alarm if it is not lifted, if another program had removed its rules, or if the robot's own programs
        started without the appliance.
        """
        if self._served is None or arms != self._arms:
            self._served, self._arms = self._lift(self._ports if arms else None), arms
        return self._served

    def _lift(self, armed: HeldPorts | None) -> str:
        if not self._hold.is_present:
            return ""
        lapsed, trouble = False, ""
        try:
            lapsed = self._hold.lift()
        except (NetworkError, OSError) as error:
            trouble = f"{error}: run `systemctl stop rosrv-hold`, which tries again"
            log.error("the boot hold is not lifted", error=str(error))
        try:
            self._hold.arm(armed)
        except OSError as error:
            log.error("the hold of the next boot keeps its last settings", error=str(error))
        if self._removed and not trouble:
            trouble = (
                f"another program removed the boot hold {counted(self._removed, 'time')}, such as `nft flush ruleset`:"
                " until it was restored, other machines could reach the robot's master and nodes past the appliance"
            )
        if trouble or not lapsed or self._ports is None or self._ports.own_seconds is None:
            return trouble
        return (
            f"the appliance served more than {self._ports.own_seconds} s after the hold began, so the robot's own "
            "programs may have started without it: restart them"
        )


_LIVES_A_MINUTE = 64  # starts of a failing rosout; an old connection occupies each port for a minute
_UNPRIVILEGED = range(1024, 65_536)
_FILES = 65_536  # open files: each kept socket counts twice while it is sent to a new control

log = structlog.get_logger()


def run_appliance(
    settings: Settings,
    roles: tuple[Role, ...],
    ready: Callable[[ControlReady, Settings], None],
    *,
    node_ports: range,
    pairing: Pairing | None = None,
    waits: Callable[[], None] = lambda: None,
) -> None:
    """Run the appliance until it is stopped. Raises `StartError`.

    `ready` is called once, with the settings after all ports are chosen; `waits` once, if one with `pairing` stands
    by.
    """
    if settings.isolation == "none":
        log.warning(
            "isolation none: NO FIREWALL. Every user of this machine can reach the ROS master; "
            "for development only, use --isolation netns or container"
        )
    elif os.geteuid() != 0:
        raise StartError(
            f"isolation {settings.isolation} needs root (or use --isolation none, without a firewall)"
        )
    elif settings.firewall.backend == "iptables":
        load_modules()
    if settings.relaying == "monitored":
        log.warning(
            "relaying monitored: NO BOUNDARY. Only topics and services with a monitor, or that [Monitor], [Limits], "
            "[Authority] or ask name, are carried; nodes negotiate the rest among themselves, past policy and "
            "monitors. It takes effect for a running node when it reconnects",
            mediation=settings.mediation,
        )
    raised = _weigh(pairing) if pairing is not None else 0
    drop_unused_capabilities()
    refuse_half_restored(settings.state)
    with signals.hold():
        _run(settings, roles, ready, node_ports, pairing=pairing, waits=waits, raised=raised)


def _weigh(pairing: Pairing) -> int:
    raised = raise_priority(-pairing.nice)
    if not raised:
        log.warning(
            "a busy machine can interrupt the service, because the lease has no priority: give CAP_SYS_NICE"
        )
    return raised


def _run(
    settings: Settings,
    roles: tuple[Role, ...],
    ready: Callable[[ControlReady, Settings], None],
    node_ports: range,
    *,
    pairing: Pairing | None,
    waits: Callable[[], None],
    raised: int,
) -> None:
    manager = ServiceManager.of(os.environ)
    manager.starting("locks its state, builds its firewall")
    state = StateDirectory(settings.state)
    setproctitle.setproctitle("rosrv: supervisor")  # until the lock names this process, its command line does
    try:
        settings = _with_ports(settings)
        master = settings.listen_address[1]
        ports = AppliancePorts(
            master=master,
            rosmaster=settings.rosmaster_port,
            nodes=node_ports,
            unserved=_unserved_families(settings.listen_address[0]),
            api=settings.api_address[1] if settings.api_address else None,
            api_networks=tuple(str(network) for network in settings.api_networks),
            receivers=tuple(
                (role.user, receiver)
                for role in roles
                if (receiver := role.receiver(settings.sections)) is not None
            ),
            own_node=_ports_of_rosout(settings, node_ports),
            peer=PeerAccess(pairing.other, pairing.port) if pairing is not None else None,
        )
        view = require_view(view_of(program_folders(), state.path), may_mount=has_privileges())
        work = machine_work_in(settings.state)
        isolation = isolation_for(settings.isolation, ports, settings.firewall.backend, work)
        state.prepare(roles)
        state.write_config(json.dumps(plain(settings)))
        state.write_files(pairing.files if pairing is not None else ())
        raise_file_limit(_FILES)
        hold = HoldAround(settings, used=pairing is None and manager.is_present, link=isolation.link)
        hold.put()

        def say_ready(said: ControlReady) -> None:
            ready(said, settings)
            if not isolation.awaits_graph():
                isolation.lapse = hold.lift_hold(arms=not isolation.is_released())
            manager.ready(f"nodes may connect: ROS_MASTER_URI={said.master}")

        def say_standing_by() -> None:
            waits()
            if pairing is not None:
                manager.ready(pairing.ready)

        admin = state.open_admin_socket()
        with closing(admin):
            listeners = _listeners(settings, isolation, manager, admin, hold)
            if listeners is None:
                return
            try:
                manager.starting("starts its processes")
                supervisor = partial(
                    Supervisor,
                    roles,
                    Facts(
                        state=state.path,
                        config=state.config,
                        rosmaster_port=settings.rosmaster_port,
                        rosout_ports=ports.own_node if settings.isolation != "none" else None,
                        control_reads=tuple(
                            filter(None, (settings.policy, settings.monitors, settings.hosts))
                        ),
                        sections=settings.sections,
                        ca_passphrase_file=settings.ipsec.ca_passphrase_file,
                        view=view,
                        raised=raised,
                    ),
                    admin=admin,
                    ready=say_ready,
                    relays=settings.relays,
                    isolation=isolation,
                    listeners=listeners,
                    memories=memories(settings.sections, settings.relays),
                    memory=MonitorMemory(state.path, settings.relays),
                    heartbeat=HeartbeatWiring(settings.relays, settings.relay.heartbeat_line),
                    stands_by=say_standing_by,
                    gate=pairing.gate if pairing is not None else ServiceGate,
                    work=work,
                    gives_back=hold.put_before_restart,
                )
                asyncio.run(_supervise(supervisor, isolation, hold, manager))
            finally:
                hold.put()
                isolation.remove()
    finally:
        state.close()


def _listeners(
    settings: Settings,
    isolation: NoIsolation,
    manager: ServiceManager,
    admin: socket.socket,
    hold: HoldAround,
) -> dict[str, socket.socket] | None:
    """Build the isolation, and return the appliance's listeners; None if a signal ended the wait for a port."""
    build = partial(_build, settings, isolation, hold)
    if manager.is_present or settings.isolation == "container":
        return built_when_free(build, manager, admin)
    return build()


def _build(settings: Settings, isolation: NoIsolation, hold: HoldAround) -> dict[str, socket.socket]:
    try:
        hold.keep()
        return _built(settings, isolation)
    except PortInUseError as error:
        raise PortInUseError(f"{error}{hold.held_off}") from error


def _built(settings: Settings, isolation: NoIsolation) -> dict[str, socket.socket]:
    if settings.isolation != "netns":  # before the firewall is built, because a wait tries every two seconds
        require_free(*settings.listen_address)
        require_free("127.0.0.1", settings.rosmaster_port)
        if settings.api_address is not None:
            require_free(*settings.api_address)
    isolation.build()
    try:
        with isolation.inside():
            require_free(*settings.listen_address)
            require_free("127.0.0.1", settings.rosmaster_port)
            api = _listener(settings)
            return {} if api is None else {"api": api}
    except BaseException:
        isolation.remove()
        raise


def _unserved_families(listen: str) -> tuple[Family, ...]:
    """Return the families of addresses to which this one does not answer; :: answers to both."""
    return () if listen == "::" else (4,) if family_of(listen) == 6 else (6,)


def _ports_of_rosout(settings: Settings, node_ports: range) -> range:
    chosen = local_port_range()
    taken = [settings.listen_address[1], settings.rosmaster_port]
    taken += [settings.api_address[1]] if settings.api_address else []
    return spare_ports(
        _LIVES_A_MINUTE,
        [node_ports, range(chosen.first, chosen.last + 1), *(range(port, port + 1) for port in taken)],
        _UNPRIVILEGED,
    )


def _with_ports(settings: Settings) -> Settings:
    host, port = settings.listen_address
    if port == 0 and settings.isolation != "none":
        port = free_port()
    rosmaster = settings.rosmaster_port or free_port()
    return replace(
        settings, listen=_shown(host, port), rosmaster_port=rosmaster, api=_api_with_port(settings)
    )


def _api_with_port(settings: Settings) -> str:
    if settings.api_address is None:
        return settings.api
    host, port = settings.api_address
    if port != 0 and isinstance(settings.api, Unasked):
        try:
            require_free(host, port)
        except StartError as error:
            log.warning("REST uses another port; choose one with --api HOST:PORT", reason=str(error))
            port = 0
    return _shown(host, port or free_port())


def _shown(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _listener(settings: Settings) -> socket.socket | None:
    if settings.api_address is None:
        return None
    host, port = settings.api_address
    if settings.isolation == "netns":
        host = "::" if ":" in host else "0.0.0.0"  # noqa: S104  the namespace has none of the addresses of the host
    require_free(host, port)
    family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind((host, port))
    listener.listen(256)
    return listener


async def _keep(hold: HoldAround, supervisor: Supervisor, isolation: NoIsolation) -> None:
    while True:
        isolation.lapse = await hold.until(
            lambda: supervisor.is_ready and not isolation.awaits_graph(), isolation.is_released
        )
        await asyncio.sleep(_KEEP_SECONDS)


async def _supervise(
    make: Callable[[], Supervisor], isolation: NoIsolation, hold: HoldAround, manager: ServiceManager
) -> None:
    supervisor = make()
    async with manager.watch():
        keeping = asyncio.create_task(_keep(hold, supervisor, isolation))
        try:
            await supervisor.run()
        finally:
            keeping.cancel()
            manager.stopping()
