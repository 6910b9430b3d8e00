"""`rosrv up`: start the appliance and stay until it is told to stop."""

import asyncio
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import structlog
import typer

from appliance.config import Settings
from appliance.config_sources import resolve
from appliance.supervisor.errors import StartError
from appliance.supervisor.logs import configure_logs
from appliance.supervisor.ports import free_port, require_free
from appliance.supervisor.privileges import raise_file_limit
from appliance.supervisor.roles import Facts, roles_of
from appliance.supervisor.state import StateDirectory
from appliance.supervisor.supervisor import ControlReady, Supervisor

log = structlog.get_logger()


def up(  # noqa: PLR0917  typer gives every flag by its name
    config: Annotated[
        Path | None, typer.Option(help="Configuration file (default: ./appliance.yaml)")
    ] = None,
    policy: Annotated[
        Path | None, typer.Option(help="Access policy; read again by `rosrv policy reload`")
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help="Directory of everything that survives a restart")
    ] = None,
    listen: Annotated[
        str | None, typer.Option(help="HOST:PORT where nodes find their master; port 0: any")
    ] = None,
    rosmaster_port: Annotated[int | None, typer.Option(help="Port of the hidden ROSMaster; 0: any")] = None,
    isolation: Annotated[str | None, typer.Option(help="container, netns or none")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Say in JSON when nodes may connect")] = False,
) -> None:
    """Start the appliance; ends on SIGTERM or Ctrl-C.

    Example: rosrv up --policy policies/default.ini --state /var/lib/rosrv
    """
    flags = {
        "policy": policy,
        "state": state,
        "listen": listen,
        "rosmaster_port": rosmaster_port,
        "isolation": isolation,
    }
    settings = resolve(config, os.environ, flags)
    configure_logs("supervisor")
    run(settings, as_json=as_json)


def run(settings: Settings, *, as_json: bool) -> None:
    """Run the appliance with these settings until it is told to stop. Raises `StartError`."""
    if settings.isolation == "none":
        log.warning(
            "isolation none: NO FIREWALL. Every user of this machine can reach the real ROSMaster; "
            "for development only, use --isolation netns or container"
        )
    elif os.geteuid() != 0:
        raise StartError(
            f"isolation {settings.isolation} needs root (or use --isolation none, without a firewall)"
        )
    roles = roles_of()
    require_free(*settings.listen_address)
    port = settings.rosmaster_port or free_port()
    require_free("127.0.0.1", port)
    settings = settings.model_copy(update={"rosmaster_port": port})
    raise_file_limit(16_384)
    state = StateDirectory(settings.state)
    try:
        state.prepare(roles)
        state.write_config(settings.model_dump_json())
        facts = Facts(state=state.path, config=state.config, rosmaster_port=port)

        def ready(said: ControlReady) -> None:
            _announce(said, state.path, as_json=as_json)

        async def supervise() -> None:
            await Supervisor(
                roles,
                facts,
                admin=state.open_admin_socket(),
                ready=ready,
                relays=settings.relays,
                isolation=settings.isolation,
            ).run()

        asyncio.run(supervise())
    finally:
        state.close()


def _announce(said: ControlReady, state: Path, *, as_json: bool) -> None:
    if as_json:
        event: Mapping[str, Any] = {
            "event": "ready",
            "master": said.master,
            "api": None,
            "revision": said.revision,
        }
        line = json.dumps(event)
    else:
        line = f"Nodes may connect: ROS_MASTER_URI={said.master} (state in {state})"
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
