"""Write lines to standard output."""

import json
from typing import Any

import typer

from appliance.audit.record_format import printable


def say(line: str) -> None:
    """Write one line; control characters are escaped."""
    typer.echo(printable(line))


def say_json(fields: dict[str, Any]) -> None:
    """Write one object on one line."""
    typer.echo(json.dumps(fields))
