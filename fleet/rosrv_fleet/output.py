"""Write lines to standard output, and the log to standard error."""

import json
import logging
import sys

import structlog
import typer

from appliance.audit.log.record_format import printable


def say(line: str) -> None:
    typer.echo(printable(line))


def say_json(fields: dict[str, object]) -> None:
    typer.echo(json.dumps(fields))


def configure_log() -> None:
    """Log to standard error. Tracebacks omit local variables, which might include a key or a password."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    *processors, _renderer = structlog.get_config()["processors"]
    renderer = structlog.dev.ConsoleRenderer(
        colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
    )
    structlog.configure([*processors, renderer], logger_factory=structlog.PrintLoggerFactory(sys.stderr))
