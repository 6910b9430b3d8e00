"""Write lines to standard output, and the log to standard error."""

import json
import logging

import structlog
import typer

from appliance.audit.log.record_format import printable
from appliance.base.counted import counted
from appliance.base.log_output import replace_stderr


def say(line: str) -> None:
    typer.echo(printable(line))


def note(text: str) -> None:
    typer.echo(f"rosrv-fleet: {text}", err=True)


def say_json(fields: dict[str, object]) -> None:
    typer.echo(json.dumps(fields))


def _lost(lines: int, since: str) -> str:
    return f"{counted(lines, 'line of the log was', 'lines of the log were')} lost since {since}\n"


def configure_log() -> None:
    """Log to standard error, which may be full or closed. Tracebacks omit local variables, which might include a key or
    a password.
    """
    output = replace_stderr(_lost, waits=True)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    *processors, _renderer = structlog.get_config()["processors"]
    renderer = structlog.dev.ConsoleRenderer(
        colors=output.isatty(), exception_formatter=structlog.dev.plain_traceback
    )
    structlog.configure([*processors, renderer], logger_factory=structlog.PrintLoggerFactory(output))
