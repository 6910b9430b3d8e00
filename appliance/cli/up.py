"""`rosrv up`: start the appliance and run until a signal stops it."""

# must precede the first import of structlog: see there
from appliance.supervisor.logs import configure_logs, write_line

# isort: split
import contextlib
import json
import os
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import structlog
import typer

from appliance.cli.up_inputs import read_inputs
from appliance.configuration.config_sources import resolve
from appliance.configuration.settings import Settings
from appliance.control.assembly.robot import own_address
from appliance.features.table import pairing_in
from appliance.supervisor.errors import StartError
from appliance.supervisor.roles import roles_of
from appliance.supervisor.run import run_appliance
from appliance.supervisor.service_gate import Pairing
from appliance.supervisor.supervisor import ControlReady

_MAX_WARNINGS = 10

_ISOLATIONS = {
    "netns": "in a network namespace of this host",
    "container": "in a container, in the container's namespace",
    "none": "without namespace and firewall, for development",
}

log = structlog.get_logger()


def _isolations(incomplete: str) -> list[tuple[str, str]]:
    return [(name, text) for name, text in _ISOLATIONS.items() if name.startswith(incomplete)]


# Not `readable`, which click checks with the rights of root alone: see `base/owner_access.py`.
_ConfigFile = Annotated[
    Path | None,
    typer.Option(readable=False, help="Configuration file (default: ROSRV_CONFIG, else ./appliance.yaml)"),
]
_PolicyFile = Annotated[
    Path | None,
    typer.Option(readable=False, help="Access policy file; `rosrv policy reload` reads it again"),
]
_MonitorFolder = Annotated[
    Path | None,
    typer.Option(
        readable=False, help="Folder of specifications (.rv); `rosrv monitor reload` reads it again"
    ),
]
_Enable = Annotated[
    str | None,
    typer.Option(
        help="State of monitors that no operator has switched: all (enabled), none, NAME,…, or shadow (all in"
        " shadow mode)"
    ),
]
_StateDirectory = Annotated[
    Path | None, typer.Option(help="State directory: all data that must survive a restart")
]
_Listen = Annotated[
    str | None,
    typer.Option(help="Address where nodes find their master (ROS_MASTER_URI); with port 0, any free port"),
]
_RosmasterPort = Annotated[
    int | None,
    typer.Option(help="Loopback port of the ROS master behind the appliance; with 0, any free port"),
]
_Isolation = Annotated[
    str | None,
    typer.Option(
        help="netns (a network namespace of this machine), container (the one of its container), or none (no"
        " firewall: for development only)",
        autocompletion=_isolations,
    ),
]
_Relayed = Annotated[
    str | None,
    typer.Option(
        help="Topics and services that go through the relay: all, or monitored (those that a specification, [Monitor],"
        " [Limits], [Authority] or ask names; this is not a boundary)"
    ),
]
_Mediation = Annotated[
    str | None,
    typer.Option(
        help="full: nodes see only the appliance; monitored (needs --relay monitored): nodes get each other's real"
        " URIs, so the appliance is not a boundary"
    ),
]
_Api = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Address where REST and the console listen, or off; with port 0, any free port",
    ),
]
_ApiTls = Annotated[
    str | None, typer.Option(help="TLS of REST: true, or false (clear text, on a loopback address only)")
]
_AsJson = Annotated[bool, typer.Option("--json", help="Print a JSON object when nodes may connect")]


def up(  # noqa: PLR0917  typer gives every flag by its name
    config: _ConfigFile = None,
    policy: _PolicyFile = None,
    monitors: _MonitorFolder = None,
    enable: _Enable = None,
    state: _StateDirectory = None,
    listen: _Listen = None,
    rosmaster_port: _RosmasterPort = None,
    isolation: _Isolation = None,
    relay: _Relayed = None,
    mediation: _Mediation = None,
    api: _Api = None,
    api_tls: _ApiTls = None,
    as_json: _AsJson = False,
) -> None:
    """Start the appliance and run until SIGTERM or Ctrl-C.

    An option overrides the environment and the configuration file. `rosrv config show` prints the values without
    options.

    Example: rosrv up --policy policies/default.ini --state /var/lib/rosrv
    """
    flags = {
        "policy": policy,
        "monitors": monitors,
        "enable": enable,
        "state": state,
        "listen": listen,
        "rosmaster_port": rosmaster_port,
        "isolation": isolation,
        "relaying": relay,
        "mediation": mediation,
        "api": api,
        "api_tls": api_tls,
    }
    configure_logs("supervisor")  # first: an error must not wait for a reader either
    settings = resolve(config, os.environ, flags)
    pairing = pairing_in(settings.state)
    node_ports = read_inputs(settings, None if pairing is None else pairing.robot)
    run_appliance(
        settings,
        roles_of(
            sections=settings.sections,
            api=settings.api_address is not None,
            paired=pairing is not None,
        ),
        partial(_announce, as_json=as_json),
        node_ports=node_ports,
        pairing=pairing,
        waits=partial(_announce_waiting, pairing, as_json=as_json),
    )


def _announce_waiting(pairing: Pairing | None, *, as_json: bool) -> None:
    if pairing is None:
        return
    with contextlib.suppress(OSError):
        _write(json.dumps(pairing.waiting_event) if as_json else pairing.waiting_text, as_json=as_json)


def _write(line: str, *, as_json: bool) -> None:
    if as_json:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
    else:
        write_line(line, sys.stdout)


def _announce(said: ControlReady, settings: Settings, *, as_json: bool) -> None:
    """Announce that nodes may connect. If the first token cannot be stored, print nothing and raise `StartError`."""
    line = (
        _event(said, settings)
        if as_json
        else f"Nodes may connect: ROS_MASTER_URI={said.master} (state in {settings.state})"
    )
    more = [] if as_json else _hints(said, settings)
    try:
        _write(line, as_json=as_json)
    except OSError as error:  # closed pipe, full disk, closed terminal
        kept = None if said.token is None else str(_keep_token(settings.state, said.token))
        shown = None if said.token else line
        log.warning("cannot write to standard output", error=error.strerror, first_token=kept, line=shown)
    with contextlib.suppress(OSError):
        for one in more:
            write_line(one, sys.stderr)


def _event(said: ControlReady, settings: Settings) -> str:
    event: dict[str, object] = {
        "event": "ready",
        "master": said.master,
        "api": _rest_url(settings),
        "revision": said.revision,
    }
    if said.token is not None:
        event["token"] = said.token
    if said.warnings:
        event["warnings"] = said.warnings
    return json.dumps(event)


def _hints(said: ControlReady, settings: Settings) -> list[str]:
    """Return the lines after the announcement; the first token is then in a file. Raises `StartError`."""
    lines = [*said.warnings[:_MAX_WARNINGS]]
    if len(said.warnings) > _MAX_WARNINGS:
        lines.append(
            f"and {len(said.warnings) - _MAX_WARNINGS} more warnings: rosrv policy check {settings.policy}"
        )
    if settings.isolation == "netns":
        port = settings.listen_address[1]
        lines.append(f"Nodes on other machines: this machine's address, ROS_MASTER_URI=http://ADDRESS:{port}")
    if settings.monitors is not None:
        lines.append(f"Monitors: {settings.monitors} (rosrv monitor list)")
    if (rest := _rest_url(settings)) is not None:
        browsed = rest if settings.api_published else _rest_url(settings, "127.0.0.1")
        lines += [f"Console: {browsed}/console/", f"REST: {browsed}"]
    if said.token is not None:
        lines.append(f"The first access token (admin) is in {_keep_token(settings.state, said.token)}")
    return lines


def _rest_url(settings: Settings, own: str = "") -> str | None:
    """Return the URL of REST; `own` replaces this machine's address, where REST listens on all of them.

    A container that publishes REST on loopback has an address that browsers do not reach.
    """
    if settings.api_address is None:
        return None
    host, port = settings.api_address
    if host in ("0.0.0.0", "::"):  # noqa: S104  compared only
        host = own or own_address(settings)
    shown = f"[{host}]" if ":" in host else host
    return f"{'https' if settings.api_tls else 'http'}://{shown}:{port}"


def _keep_token(state: Path, token: str) -> Path:
    """Write the token to a file that only its owner can read. Raises `StartError`; no file is then left."""
    path = state / "first-token"
    try:
        path.unlink(missing_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        try:
            os.write(descriptor, f"{token}\n".encode())
        except OSError:
            path.unlink()
            raise
        finally:
            os.close(descriptor)
    except OSError as error:
        raise StartError(
            f"cannot write the first access token to {path}: {error.strerror}; make the directory writable and start "
            "again: the next start creates another token"
        ) from error
    return path
