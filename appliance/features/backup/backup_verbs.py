"""The commands `rosrv backup`, `restore` and `purge`."""

import contextlib
import os
import shlex
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.backup.contents import BackupError
from appliance.backup.create import back_up
from appliance.base.counted import counted
from appliance.base.input_files import read_given_text
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json
from appliance.cli.typed_confirmation import Yes, confirm_state
from appliance.configuration.config_sources import ConfigError, resolve
from appliance.configuration.settings import load_resolved
from appliance.features.backup.purge import purge as remove
from appliance.features.backup.purge import require_state_directory
from appliance.features.backup.restore import restore as put_back
from rosmop.form.switch_words import without_file_switch
from rosmop.tool.terminal import printable, refusal, say

# Find the specifications in force that are only in a state directory, not in the folder of the configuration.

_STATE = "control/state.db"


class _Stored(msgspec.Struct, frozen=True):
    """The part of a stored revision that is compared."""

    files: dict[str, str] = {}


_LAST = "SELECT sources FROM monitor_revision ORDER BY revision DESC LIMIT 1"


def specifications_in(name: str, copy: Path) -> Mapping[str, str]:
    """Return the texts in force, by file, if the archived file of this name is the state. Raises `sqlite3.Error`."""
    if name != _STATE:
        return {}
    with closing(sqlite3.connect(f"{copy.as_uri()}?mode=ro", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'monitor_revision'").fetchone():
            return {}
        row = database.execute(_LAST).fetchone()
    return msgspec.json.decode(row[0], type=_Stored).files if row else {}


def lacking_in_folder(state: Path, texts: Mapping[str, str]) -> list[str]:
    """Return the files whose texts are not in the folder that the appliance of this state uses, or will use."""
    try:
        running = state / "run" / "config.json"
        folder = (load_resolved(running) if running.exists() else resolve(None, os.environ, {})).monitors
    except (OSError, ValueError, ConfigError):
        folder = None
    return [file for file, text in texts.items() if not _has(folder, file, text)]


def _has(folder: Path | None, file: str, text: str) -> bool:
    try:
        there = "" if folder is None else read_given_text(folder / file, "utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return False
    return without_file_switch(there) == without_file_switch(text)


_NewState = Annotated[
    Path,
    typer.Option("--state", envvar="ROSRV_STATE", help="State directory to create; must be absent or empty"),
]


def backup(
    file: Annotated[
        Path,
        typer.Argument(help="File to write; must not exist. It contains private keys"),
    ],
    state: State = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Write the state directory to one file: audit log, registrations, policies, keys. The appliance may be running.

    Your own files are not included: configuration, policy and specifications. Specifications in force that the folder
    lacks are only in the state directory; they are named.

    Example: rosrv backup /media/safe/rosrv-2026-03-01.tar.gz
    """
    texts: dict[str, str] = {}
    try:
        names = back_up(state, file, lambda name, copy: texts.update(specifications_in(name, copy)))
    except BackupError as error:
        raise _failure(str(error)) from None
    size, only_here = file.stat().st_size, lacking_in_folder(state, texts)
    if as_json:
        say_json({"file": str(file), "files": len(names), "bytes": size, "only_in_state": only_here})
        return
    say(f"{file}: {counted(len(names), 'file')}, {size} bytes")
    if only_here:
        what = f"only in the state directory, not like this in the folder of specifications: {', '.join(only_here)}"
        say(f"{what}; rosrv guard list names the command for guards", "yellow")


def restore(
    file: Annotated[Path, typer.Argument(help="File written by `rosrv backup`")],
    state: _NewState = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Create a state directory from a backup, for `rosrv up --state`. Existing files are never overwritten.

    Example: rosrv restore rosrv-2026-03-01.tar.gz --state /var/lib/rosrv
    """
    try:
        names = put_back(file, state)
    except BackupError as error:
        raise _failure(str(error)) from None
    if as_json:
        say_json({"state": str(state), "files": len(names)})
    else:
        say(
            f"{state}: {counted(len(names), 'file')}; verify the log: rosrv audit verify --state"
            f" {shlex.quote(str(state))}"
        )


def purge(
    context: typer.Context,
    state: State = DEFAULT_STATE,
    *,
    yes: Yes = False,  # noqa: ARG001  `confirm_state` reads it
    as_json: Json = False,
) -> None:
    """Erase a state directory: audit log, policies, keys of the appliance and its hosts. Stop the appliance first.

    Keys and other small files are overwritten first; copies inside the disk, as SSDs make them, cannot be
    erased.

    Example: rosrv purge --state /var/lib/rosrv
    """
    try:
        with contextlib.suppress(PermissionError):  # which `confirm_state` reports
            if state.is_dir():
                require_state_directory(state)
    except BackupError as error:
        raise _failure(str(error)) from None
    confirm_state(context, state, f"This erases everything in {printable(str(state))} permanently")
    try:
        files, written = remove(state)
    except BackupError as error:
        raise _failure(str(error)) from None
    if as_json:
        say_json({"state": str(state), "files": files, "written_over": written})
    else:
        say(f"{state} is erased: {counted(files, 'file')}, {written} of them overwritten first")


def _failure(text: str) -> typer.Exit:
    return refusal([f"rosrv: {text}"])
