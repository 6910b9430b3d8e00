"""One life of the appliance: what must be right before the first process starts, and what is left behind."""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import structlog

from appliance.config import Settings
from appliance.supervisor.enclosure import Enclosure, Ports, enclosure_of
from appliance.supervisor.errors import StartError
from appliance.supervisor.ports import free_port, require_free
from appliance.supervisor.privileges import keep_supervisors, raise_file_limit
from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.state import StateDirectory
from appliance.supervisor.supervisor import ControlReady, Supervisor

_FILES = 65_536  # each kept socket, and once more while it is on its way to a new control

log = structlog.get_logger()


def run_appliance(
    settings: Settings,
    roles: tuple[Role, ...],
    ready: Callable[[ControlReady, Path], None],
    *,
    node_ports: range,
) -> None:
    """Run the appliance until it is told to stop. Raises `StartError` when it cannot start or go on.

    `ready` is called once, with what control says and the state directory, when nodes may connect.
    `node_ports` are those of the policy's `[Ports] range`: what the firewall limits and `netns` forwards.
    """
    if settings.isolation == "none":
        log.warning(
            "isolation none: NO FIREWALL. Every user of this machine can reach the real ROSMaster; "
            "for development only, use --isolation netns or container"
        )
    elif os.geteuid() != 0:
        raise StartError(
            f"isolation {settings.isolation} needs root (or use --isolation none, without a firewall)"
        )
    keep_supervisors()
    state = StateDirectory(settings.state)
    try:
        settings = _with_ports(settings)
        master = settings.listen_address[1]
        ports = Ports(master=master, rosmaster=settings.rosmaster_port, nodes=node_ports)
        enclosure = enclosure_of(settings.isolation, ports, settings.firewall.backend)
        state.prepare(roles)
        state.write_config(settings.model_dump_json())
        raise_file_limit(_FILES)
        enclosure.build()
        try:
            _supervise(settings, roles, state, enclosure, ready)
        finally:
            enclosure.remove()
    finally:
        state.close()


def _with_ports(settings: Settings) -> Settings:
    """The settings with every port chosen that must be known before the first process starts."""
    host, port = settings.listen_address
    if port == 0 and settings.isolation != "none":
        port = free_port()
    rosmaster = settings.rosmaster_port or free_port()
    shown = f"[{host}]" if ":" in host else host
    return settings.model_copy(update={"listen": f"{shown}:{port}", "rosmaster_port": rosmaster})


def _supervise(
    settings: Settings,
    roles: tuple[Role, ...],
    state: StateDirectory,
    enclosure: Enclosure,
    ready: Callable[[ControlReady, Path], None],
) -> None:
    with enclosure.inside():
        require_free(*settings.listen_address)
        require_free("127.0.0.1", settings.rosmaster_port)

    async def supervise() -> None:
        await Supervisor(
            roles,
            Facts(state=state.path, config=state.config, rosmaster_port=settings.rosmaster_port),
            admin=state.open_admin_socket(),
            ready=lambda said: ready(said, state.path),
            relays=settings.relays,
            enclosure=enclosure,
        ).run()

    asyncio.run(supervise())
