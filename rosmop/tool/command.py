"""The `rosmop` command."""

from pathlib import Path

import typer

from rosmop.tool import check_command, coverage_command, learn_command, run_command
from rosmop.tool.options import (
    Bag,
    Bags,
    Dot,
    FailUnder,
    Files,
    Folders,
    HoldOut,
    Json,
    Out,
    Output,
    Prove,
    Svg,
    Topics,
)
from rosmop.tool.program import Program

_ROSMOP = Program("rosmop", "rosmop", Path.read_bytes, lambda path: path.open("rb"), Path.write_bytes)

app = typer.Typer(
    name="rosmop",
    help="Runtime monitors for ROS 1: check specifications, and try them on recordings.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def check(
    files: Files,
    *,
    as_json: Json = False,
    msg: Folders = None,
    prove: Prove = False,
    dot: Dot = None,
    svg: Svg = None,
) -> None:
    """Report every error and warning with its place; exit status 1 if there is an error.

    Example: rosmop check monitors/*.rv
    """
    status = check_command.check(_ROSMOP, files, msg or [], as_json=as_json, prove=prove, dot=dot, svg=svg)
    raise typer.Exit(status)


@app.command()
def run(files: Files, *, bag: Bag, as_json: Json = False, output: Output = None, msg: Folders = None) -> None:
    """Give a recording to the monitors and report what came of every message, by the recording's clock.

    Example: rosmop run monitors/safe_triggering.rv --bag drive.bag
    """
    run_command.run(_ROSMOP, files, msg or [], bag, output=output, as_json=as_json)


@app.command("learn")
def learn_monitors(
    bags: Bags, topics: Topics = None, out: Out = None, hold_out: HoldOut = 0.3, as_json: Json = False
) -> None:
    """Propose specifications out of recordings of a robot that behaves, for a person to edit.

    Example: rosmop learn --bag monday.bag --bag tuesday.bag --out learnt.rv
    """
    learn_command.learn_monitors(_ROSMOP, bags, topics or [], out, hold_out=hold_out, as_json=as_json)


@app.command()
def coverage(
    files: Files, *, bags: Bags, msg: Folders = None, fail_under: FailUnder = 0.0, as_json: Json = False
) -> None:
    """Say which events, branches, handlers, states and transitions recordings exercised, and what never happened.

    Example: rosmop coverage monitors/*.rv --bag drive.bag --fail-under 80
    """
    raise typer.Exit(
        coverage_command.coverage(_ROSMOP, files, msg or [], bags, fail_under=fail_under, as_json=as_json)
    )
