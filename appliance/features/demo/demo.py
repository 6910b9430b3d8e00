"""`rosrv demo`: run `examples/landshark`, which is installed with the program."""

import importlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.shipped import SHIPPED
from rosmop.tool.terminal import refusal


def demo(
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep everything running at the end, until Ctrl-C")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="File (SVG) for a picture of the robot's paths, without and with monitors"
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="One JSON object for each result; all other text goes to standard error"),
    ] = False,
    standby: Annotated[
        bool,
        typer.Option(
            "--standby",
            help="Show two appliances instead; the active one loses its power while the operator drives",
        ),
    ] = False,
    adopt: Annotated[
        bool,
        typer.Option(
            "--adopt", help="Show `rosrv adopt` and `rosrv release` instead, on a robot that drives"
        ),
    ] = False,
) -> None:
    """Show the appliance at work: a simulated robot, its operator and an attacker. Needs root.

    Exit status: 0 the robot obeyed only its operator (with --standby: the standby took over; with --adopt: it never
    stopped), 1 it did not.

    Example: rosrv demo --keep --output drive.svg
    """
    if not (SHIPPED / "examples").is_dir():
        why = f"the simulated robot is missing from {SHIPPED}: install rosrv again"
        raise refusal([f"rosrv demo: {why}; beside the container it is `docker compose --profile demo up`"])
    if (standby or adopt) and output is not None:
        raise refusal(
            [
                "rosrv demo: --output draws the drives of the demonstration without --standby and --adopt: leave it out"
            ]
        )
    if standby and adopt:
        raise refusal(["rosrv demo: --standby and --adopt are two demonstrations: give one"])
    sys.path.insert(0, str(SHIPPED))
    demonstration = importlib.import_module("examples.landshark.demonstration")
    raise typer.Exit(
        demonstration.demonstrate(hold=keep, picture=output, as_json=as_json, standby=standby, adopt=adopt)
    )
