"""`rosrv backup`, `restore` and `purge`: the state directory in one file, and back; and its end."""

from pathlib import Path
from typing import Annotated

import typer

from appliance.backup.contents import BackupError
from appliance.backup.create import back_up
from appliance.backup.purge import purge as remove
from appliance.backup.restore import restore as put_back
from appliance.cli.output import Json, say_json
from appliance.cli.target import DEFAULT_STATE, State
from rosmop.tool.terminal import printable, refused, say

_NewState = Annotated[
    Path,
    typer.Option(
        "--state", envvar="ROSRV_STATE", help="State directory to make; must not exist, or be empty"
    ),
]


def backup(
    file: Annotated[Path, typer.Argument(help="Where to; must not exist. It has keys in it: keep it as one")],
    state: State = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Write the state directory to one file: audit log, registrations, policies, keys. The appliance may run.

    Configuration, policy and specifications are your own files and not in it.

    Example: rosrv backup /media/safe/rosrv-2026-03-01.tar.gz --state /var/lib/rosrv
    """
    try:
        names = back_up(state, file)
    except BackupError as error:
        raise _failed(str(error)) from None
    size = file.stat().st_size
    if as_json:
        say_json({"file": str(file), "files": len(names), "bytes": size})
    else:
        say(f"{file}: {len(names)} files, {size} bytes")


def restore(
    file: Annotated[Path, typer.Argument(help="What `rosrv backup` wrote")],
    state: _NewState = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Make a state directory of a backup; `rosrv up --state` there goes on from it. Nothing is written over.

    Example: rosrv restore /media/safe/rosrv-2026-03-01.tar.gz --state /var/lib/rosrv
    """
    try:
        names = put_back(file, state)
    except BackupError as error:
        raise _failed(str(error)) from None
    if as_json:
        say_json({"state": str(state), "files": len(names)})
    else:
        say(f"{state}: {len(names)} files; prove the log: rosrv audit verify --state {state}")


def purge(
    state: State = DEFAULT_STATE,
    confirm: Annotated[
        str | None,
        typer.Option(metavar="DIR", help="The state directory once more, for scripts; else it is asked for"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Remove a state directory for good: audit log, policies, keys of the appliance and of its hosts. It must not run.

    Keys and other small files are written over first; what the disk itself keeps of them is not reached.

    Example: rosrv purge --state /var/lib/rosrv
    """
    if confirm is None:
        text = (
            f"Everything in {printable(str(state))} is lost for good. Write the path once more to remove it"
        )
        confirm = str(typer.prompt(text, err=True))
    if Path(confirm).absolute() != state.absolute():
        raise _failed(f"{confirm} is not {state}: nothing was removed")
    try:
        files, written = remove(state)
    except BackupError as error:
        raise _failed(str(error)) from None
    if as_json:
        say_json({"state": str(state), "files": files, "written_over": written})
    else:
        say(f"{state} is gone: {files} files, {written} of them written over first")


def _failed(text: str) -> typer.Exit:
    return refused([f"rosrv: {text}"])
