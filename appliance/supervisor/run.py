"""One life of the appliance: what must be right before the first process starts, and what is left behind."""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import structlog

from appliance.config import Settings
from appliance.supervisor.errors import StartError
from appliance.supervisor.ports import free_port, require_free
from appliance.supervisor.privileges import raise_file_limit
from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.state import StateDirectory
from appliance.supervisor.supervisor import ControlReady, Supervisor

_FILES = 65_536  # each kept socket, and once more while it is on its way to a new control

log = structlog.get_logger()


def run_appliance(
    settings: Settings, roles: tuple[Role, ...], ready: Callable[[ControlReady, Path], None]
) -> None:
    """Run the appliance until it is told to stop. Raises `StartError` when it cannot start or go on.

    `ready` is called once, with what control says and the state directory, when nodes may connect.
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
    state = StateDirectory(settings.state)
    try:
        _run(settings, roles, state, ready)
    finally:
        state.close()


def _run(
    settings: Settings,
    roles: tuple[Role, ...],
    state: StateDirectory,
    ready: Callable[[ControlReady, Path], None],
) -> None:
    require_free(*settings.listen_address)
    port = settings.rosmaster_port or free_port()
    require_free("127.0.0.1", port)
    raise_file_limit(_FILES)
    state.prepare(roles)
    state.write_config(settings.model_copy(update={"rosmaster_port": port}).model_dump_json())

    async def supervise() -> None:
        await Supervisor(
            roles,
            Facts(state=state.path, config=state.config, rosmaster_port=port),
            admin=state.open_admin_socket(),
            ready=lambda said: ready(said, state.path),
            relays=settings.relays,
            isolation=settings.isolation,
        ).run()

    asyncio.run(supervise())
