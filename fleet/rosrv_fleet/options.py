"""Define the options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

Config = Annotated[
    Path, typer.Option("--config", envvar="ROSRV_FLEET_CONFIG", help="The collector's configuration file")
]
DEFAULT_CONFIG = Path("/etc/rosrv-fleet/fleet.yaml")
Json = Annotated[bool, typer.Option("--json", metavar="", help="One JSON object a line (NDJSON)")]
