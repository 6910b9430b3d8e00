"""The command `rosrv selftest`."""

import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from appliance.base.counted import counted
from appliance.cli.connection.admin_client import ADMIN_SOCKET, AdminSocket
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json
from appliance.configuration.config_sources import ConfigError, resolve
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.selftest.file_checks import files
from appliance.features.selftest.live_checks import running
from appliance.features.selftest.machine_checks import machine
from appliance.features.selftest.selftest_findings import SelftestFinding, fail
from rosmop.tool.tables import say_table
from rosmop.tool.terminal import printable

_STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red", "skip": "dim"}


@speaks_with("One JSON object for each check")
def selftest(
    appliance: Appliance,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            readable=False,
            help="Configuration file (default: ROSRV_CONFIG, else ./appliance.yaml)",
        ),
    ] = None,
) -> None:
    """Check whether this machine can run the appliance, and whether a running appliance works.

    Without --api: check programs, users, namespaces, firewall, tunnels, ports, and the files of the configuration.
    For a running appliance, also check its status, its audit log, a call through RVMaster and a message through the
    relay. With --api: check only the running appliance, from here. Exit status: 0 no failures, 1 failures.

    Example: sudo rosrv selftest
    """
    failed = warned = 0
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in _all(appliance, config):
        failed += finding.outcome == "fail"
        warned += finding.outcome == "warn"
        if appliance.as_json:
            say_json(asdict(finding))
            sys.stdout.flush()
        else:
            text = Text(printable(finding.text))
            if finding.advice:
                text.append(
                    f"\n-> {printable(finding.advice)}", style="bold" if finding.outcome == "fail" else "dim"
                )
            table.add_row(Text(finding.outcome, style=_STYLES[finding.outcome]), finding.check, text)
    if not appliance.as_json:
        say_table(table)
        end = f"{failed} failed, {counted(warned, 'warning')}" if failed else counted(warned, "warning")
        Console(highlight=False).print(Text(end, style="bold red" if failed else "green"))
    raise typer.Exit(1 if failed else 0)


def _all(appliance: Appliance, config: Path | None) -> Iterator[SelftestFinding]:
    if appliance.place is not None:
        yield from running(appliance)
        return
    yield from _here(appliance, config)
    if appliance.said or _runs(appliance):
        yield from running(appliance)


def _here(appliance: Appliance, config: Path | None) -> Iterator[SelftestFinding]:
    try:
        settings = _settings(appliance, config)
    except ConfigError as error:
        for mistake in error.mistakes:
            yield fail("configuration", f"{mistake.place}: {mistake.text}", "rosrv config check")
        return
    yield from machine(settings, running=_runs(appliance))
    yield from files(settings)


def _settings(appliance: Appliance, config: Path | None) -> Settings:
    state = _state(appliance)
    resolved = None if state is None else state / "run" / "config.json"
    if config is None and resolved is not None and _runs(appliance):
        try:
            return load_resolved(resolved)
        except (OSError, ValueError):
            pass  # unreadable for this user: use the local configuration
    environment = {name: value for name, value in os.environ.items() if name != "ROSRV_STATE"}
    return resolve(config, environment, {"state": state if appliance.said else None})


def _state(appliance: Appliance) -> Path | None:
    return appliance.way.state if isinstance(appliance.way, AdminSocket) else None


def _runs(appliance: Appliance) -> bool:
    state = _state(appliance)
    return state is not None and (state / ADMIN_SOCKET).exists()
