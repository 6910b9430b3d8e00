"""`rosrv monitor check|run|learn|coverage`: judge specifications, try them on recordings; no appliance needs to run.

Exit status: 0 right (warnings or not), whatever the verdicts; 1 a specification with errors; 2 usage.
"""

import typer

from appliance.cli.monitor.monitor_program import MONITOR
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

    `--prove` needs the package z3-solver, takes up to a few seconds for each event, and says of each what is proved;
    exit status 1 if code of one does something else.

    Example: rosrv monitor check monitors/*.rv
    """
    status = check_command.check(MONITOR, files, msg or [], as_json=as_json, prove=prove, dot=dot, svg=svg)
    raise typer.Exit(status)


def run(files: Files, *, bag: Bag, as_json: Json = False, output: Output = None, msg: Folders = None) -> None:
    """Give a recording to the monitors and report what came of every message, by the recording's clock.

    Example: rosrv monitor run monitors/safe_triggering.rv --bag drive.bag
    """
    run_command.run(MONITOR, files, msg or [], bag, output=output, as_json=as_json)


def learn_monitors(
    bags: Bags, topics: Topics = None, out: Out = None, hold_out: HoldOut = 0.3, as_json: Json = False
) -> None:
    """Propose specifications out of recordings of a robot that behaves, for a person to edit.

    Example: rosrv monitor learn --bag monday.bag --bag tuesday.bag --out learnt.rv
    """
    learn_command.learn_monitors(MONITOR, bags, topics or [], out, hold_out=hold_out, as_json=as_json)


def coverage(
    files: Files, *, bags: Bags, msg: Folders = None, fail_under: FailUnder = 0.0, as_json: Json = False
) -> None:
    """Say which events, branches, handlers, states and transitions recordings exercised, and what never happened.

    Example: rosrv monitor coverage monitors/*.rv --bag drive.bag --fail-under 80
    """
    raise typer.Exit(
        coverage_command.coverage(MONITOR, files, msg or [], bags, fail_under=fail_under, as_json=as_json)
    )
