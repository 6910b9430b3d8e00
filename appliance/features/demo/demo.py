"""`rosrv demo`: run `examples/landshark`, which is installed with the program."""

import importlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.shipped import SHIPPED
from rosmop.tool.terminal import refused


def demo(
    hold: Annotated[
        bool, typer.Option("--hold", help="Keep everything running at the end, until Ctrl-C")
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE.svg", help="Draw the robot's paths from above, without and with monitors"),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object for each result; the story goes to standard error")
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
            "--adopt", help="Show instead a robot that drives while it is adopted and released: rosrv adopt"
        ),
    ] = False,
) -> None:
    """Show the appliance at work: a simulated robot, its operator and an attacker. Needs root.

    Exit status: 0 the robot obeyed only its operator (with --standby: the standby took over; with --adopt: it never
    stopped), 1 it did not.

    Example: rosrv demo --hold --picture drive.svg
    """
    if not (SHIPPED / "examples").is_dir():
        raise refused([f"rosrv demo: the simulated robot is missing from {SHIPPED}: install rosrv again"])
    if (standby or adopt) and picture is not None:
        raise refused(
            ["rosrv demo: --picture draws the drives of the demonstration without --standby and --adopt"]
        )
    if standby and adopt:
        raise refused(["rosrv demo: --standby and --adopt are two demonstrations"])
    sys.path.insert(0, str(SHIPPED))
    demonstration = importlib.import_module("examples.landshark.demonstration")
    raise typer.Exit(
        demonstration.demonstrate(hold=hold, picture=picture, as_json=as_json, standby=standby, adopt=adopt)
    )
