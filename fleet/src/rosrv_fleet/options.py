"""Define the options that several commands share, with the names and kinds of values that `rosrv` has."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.durations import bounded_seconds

Config = Annotated[
    Path,
    typer.Option(
        "--config", envvar="ROSRV_FLEET_CONFIG", metavar="FILE", help="The collector's configuration file"
    ),
]
DEFAULT_CONFIG = Path("/etc/rosrv-fleet/fleet.yaml")
Json = Annotated[bool, typer.Option("--json", metavar="", help="One JSON object a line (NDJSON)")]


def duration(shortest: str, longest: str) -> Callable[[str | float], float]:
    """Return a parser of seconds."""

    def parse(given: str | float) -> float:
        if isinstance(given, float):  # typer also converts the default
            return given
        try:
            return bounded_seconds(given, shortest, longest)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None

    return parse
