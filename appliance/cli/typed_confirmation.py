"""Ask for the state directory again before an order that cannot be undone."""

from pathlib import Path
from typing import Annotated

import typer

from rosmop.tool.terminal import printable, refused

Confirm = Annotated[
    str | None,
    typer.Option(metavar="DIR", help="The state directory again, for scripts (default: ask for it)"),
]


def confirm_state(state: Path, given: str | None, consequence: str) -> None:
    """Exit with status 1 unless the operator types the state directory, or has given it."""
    try:
        found = state.is_dir()
    except PermissionError as error:
        raise refused([f"rosrv: {error.filename}: {error.strerror}; run this as root"]) from None
    if not found:
        raise refused(
            [f"rosrv: {state}: no such directory; give the appliance's state directory with --state"]
        )
    if given is None:
        given = str(typer.prompt(f"{consequence}. Type {printable(str(state))} to continue", err=True))
    if Path(given).absolute() != state.absolute():
        raise refused([f"rosrv: {printable(given)} is not {printable(str(state))}: nothing was changed"])
