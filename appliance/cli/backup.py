"""`rosrv backup`, `restore` and `purge`: the state directory in one file, and back; and its end."""

import json
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from appliance.audit.output import printable
from appliance.backup.contents import BackupError
from appliance.backup.create import back_up
from appliance.backup.purge import purge as remove
from appliance.backup.restore import restore as put_back
from appliance.cli.running import DEFAULT_STATE, State

_NewState = Annotated[
    Path,
    typer.Option(
        "--state", envvar="ROSRV_STATE", help="State directory to make; must not exist, or be empty"
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="One JSON object")]


def backup(
    file: Annotated[Path, typer.Argument(help="Where to; must not exist. It has keys in it: keep it as one")],
    state: State = DEFAULT_STATE,
    as_json: _Json = False,
) -> None:
    """Write the state directory to one file: audit log, registrations, policies, keys. The appliance may run.

    Configuration, policy and specifications are your own files and not in it.

    Example: rosrv backup /media/safe/rosrv-2026-03-01.tar.gz --state /var/lib/rosrv
    """
    try:
        names = back_up(state, file)
    except BackupError as error:
        _fail(str(error))
    size = file.stat().st_size
    if as_json:
        sys.stdout.write(json.dumps({"file": str(file), "files": len(names), "bytes": size}) + "\n")
    else:
        sys.stdout.write(f"{printable(str(file))}: {len(names)} files, {size} bytes\n")


def restore(
    file: Annotated[Path, typer.Argument(help="What `rosrv backup` wrote")],
    state: _NewState = DEFAULT_STATE,
    as_json: _Json = False,
) -> None:
    """Make a state directory of a backup; `rosrv up --state` there goes on from it. Nothing is written over.

    Example: rosrv restore /media/safe/rosrv-2026-03-01.tar.gz --state /var/lib/rosrv
    """
    try:
        names = put_back(file, state)
    except BackupError as error:
        _fail(str(error))
    if as_json:
        sys.stdout.write(json.dumps({"state": str(state), "files": len(names)}) + "\n")
        return
    place = printable(str(state))
    sys.stdout.write(f"{place}: {len(names)} files; prove the log: rosrv audit verify --state {place}\n")


def purge(
    state: State = DEFAULT_STATE,
    confirm: Annotated[
        str | None,
        typer.Option(metavar="DIR", help="The state directory once more, for scripts; else it is asked for"),
    ] = None,
    as_json: _Json = False,
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
        _fail(f"{confirm} is not {state}: nothing was removed")
    try:
        files, written = remove(state)
    except BackupError as error:
        _fail(str(error))
    if as_json:
        sys.stdout.write(json.dumps({"state": str(state), "files": files, "written_over": written}) + "\n")
    else:
        sys.stdout.write(
            f"{printable(str(state))} is gone: {files} files, {written} of them written over first\n"
        )


def _fail(text: str) -> NoReturn:
    sys.stderr.write(f"rosrv: {printable(text)}\n")
    raise typer.Exit(1)
