"""Define the options that several commands share, with the names and kinds of values that `rosrv` has."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.durations import bounded_seconds, is_bare

Config = Annotated[
    Path,
    typer.Option(
        "--config", envvar="ROSRV_FLEET_CONFIG", metavar="FILE", help="The collector's configuration file"
    ),
]
DEFAULT_CONFIG = Path("/etc/rosrv-fleet/fleet.yaml")
Json = Annotated[bool, typer.Option("--json", metavar="", help="One JSON object a line (NDJSON)")]


def duration(shortest: str, longest: str, *, bare: str) -> Callable[[str | float], float]:
    """Return a parser of seconds, for an option that took numbers in the unit `bare` in the last release."""

    def parsed(given: str | float) -> float:
        if isinstance(given, float):  # typer also converts the default
            return given
        text = given
        if is_bare(text):
            text += bare
            typer.echo(f"rosrv-fleet: {given} is now {text}", err=True)
        try:
            return bounded_seconds(text, shortest, longest)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None

    return parsed
