"""Ask for the state directory before an order that cannot be undone."""

from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.output import usage_error
from rosmop.tool.terminal import printable, refusal

Yes = Annotated[bool, typer.Option("--yes", help="Do not ask; needs --state")]


def confirm_state(context: typer.Context, state: Path, consequence: str) -> None:
    """Exit with status 1 unless the operator types the state directory, or has agreed with --yes."""
    given = None
    if context.params["yes"]:
        source = context.get_parameter_source("state")
        if source is None or source.name != "COMMANDLINE":
            raise usage_error(f"--yes needs the directory: --state {state}", f"rosrv {context.info_name}")
        given = str(state)
    try:
        found = state.is_dir()
    except PermissionError as error:
        raise refusal([f"rosrv: {error.filename}: {error.strerror}; run this as root"]) from None
    if not found:
        raise refusal(
            [f"rosrv: {state}: no such directory; give the appliance's state directory with --state"]
        )
    if given is None:
        given = str(typer.prompt(f"{consequence}. Type {printable(str(state))} to continue", err=True))
    if Path(given).absolute() != state.absolute():
        raise refusal([f"rosrv: {printable(given)} is not {printable(str(state))}: nothing was changed"])
