"""The `rosmop` command."""

from pathlib import Path

import typer

from rosmop.tool import check_command
from rosmop.tool.options import Dot, Files, Folders, Json, Prove, Svg
from rosmop.tool.program import Program

_ROSMOP = Program("rosmop", "rosmop", Path.read_bytes)

app = typer.Typer(
    name="rosmop",
    help="Runtime monitors for ROS 1: check specifications, and try them on recordings.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def _commands() -> None:
    pass


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
