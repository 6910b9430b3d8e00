"""`rosrv config check|show`: validate and print the configuration."""

import json
import os
import sqlite3
import sys
from pathlib import Path
from typing import Annotated

import typer
import yaml

from appliance.configuration.config_sources import ConfigError, Mistake, json_schema, plain, resolve
from appliance.configuration.settings import Settings
from appliance.supervisor.state_directory import made_before_0_4, read_only
from rosmop.tool.terminal import printable

_SOURCES = "SELECT sources FROM monitor_revision ORDER BY revision DESC LIMIT 1"

_CheckedFile = Annotated[
    Path | None, typer.Argument(readable=False, metavar="FILE", help="The same as --config FILE")
]
_File = Annotated[
    Path | None,
    typer.Option(
        "--config", readable=False, help="Configuration file (default: ROSRV_CONFIG, else ./appliance.yaml)"
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]


def check(file: _CheckedFile = None, config: _File = None, as_json: _Json = False) -> None:
    """Report every error in the configuration file and the environment variables. Exit status: 0 valid, 1 errors.

    A state directory that this version cannot continue is also an error. Guards of releases before 0.4, and REST for
    other machines without `api_names`, are named.

    Example: rosrv config check appliance.yaml
    """
    try:
        settings = resolve(file or config, os.environ, {})
        _check_state(settings)
    except ConfigError as error:
        if not as_json:
            raise
        for mistake in error.mistakes:
            _print(json.dumps({"place": mistake.place, "text": mistake.text}))
        raise typer.Exit(1) from error
    if settings.api_networks and not (settings.rest_names or settings.ipsec.endpoint):
        text = "other machines may connect, but only by address or this machine's own name: list the name that they use"
        typer.echo(f"rosrv: api_names: {text}", err=True)
    if not as_json:
        _print("The configuration is valid.")


def _check_state(settings: Settings) -> None:
    """Name guards of releases before 0.4. Raises `ConfigError` for a state that this version cannot continue."""
    files: dict[str, str] = {}
    try:
        for path in settings.monitors.glob("*.rv") if settings.monitors is not None else ():
            files[path.name] = path.read_text(encoding="utf-8", errors="replace")
        if reason := made_before_0_4(settings.state):
            raise ConfigError([Mistake("state", reason)])
        files |= _stored_files(settings.state)
    except (OSError, sqlite3.Error) as error:
        typer.echo(
            f"rosrv: the stored state is not checked: {printable(str(error))}; run this as root", err=True
        )
    for file in sorted(file for file, text in files.items() if text.startswith("// preset ")):
        text = (
            "a guard of a release before 0.4, here only a monitor: while 0.4 serves, run rosrv guard upgrade"
        )
        typer.echo(f"rosrv: {printable(file)}: {text}", err=True)


def _stored_files(state: Path) -> dict[str, str]:
    """Return the specifications in force by their files."""
    with read_only(state) as database:
        row = database.execute(_SOURCES).fetchone() if database is not None else None
    return {} if row is None else dict(json.loads(row[0])["files"])


def show(
    config: _File = None,
    as_json: _Json = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of the file instead")
    ] = False,
) -> None:
    """Print every key with its effective value, defaults included.

    Example: rosrv config show --schema
    """
    if schema:
        _print(json.dumps(json_schema(), indent=2))
        return
    settings = plain(resolve(config, os.environ, {}))
    _print(json.dumps(settings) if as_json else yaml.safe_dump(settings, sort_keys=False).rstrip())


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
