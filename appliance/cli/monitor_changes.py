"""Report changes of the monitors in force, for `rosrv monitor` and `rosrv guard`, and write guards into the folder of
specifications, with their switches. The appliance itself never writes to it.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.atomic_files import write_where_told
from appliance.base.counted import counted
from appliance.base.input_files import read_given_text
from appliance.channel import admin
from appliance.channel.answers.monitor_answers import Monitors, MonitorState, Replaced, Replacement
from appliance.cli.commit_confirm import say_deadline
from appliance.cli.connection.target import Appliance
from appliance.cli.output import moment
from rosmop.form.switch_words import with_file_switch
from rosmop.tool.terminal import say

Hold = Annotated[
    bool,
    typer.Option(
        "--hold",
        help="Load even if a monitor then holds topics in use: it drops their messages until `rosrv monitor resume`",
    ),
]


def say_replaced(body: Replaced | Replacement, enforce: str = "rosrv monitor enforce") -> None:
    for warning in body.warnings:
        say(str(warning), "yellow")
    parts = [
        f"{word} {', '.join(files)}"
        for word, files in (("added", body.added), ("changed", body.changed), ("removed", body.removed))
        if files
    ]
    what = "; ".join(parts) or "no difference"
    if body.revision == body.replaced:
        say(f"no change: revision {body.revision} of the specifications stays in force")
    else:
        say(f"revision {body.revision} of the specifications is in force (was {body.replaced}): {what}")
    if body.moved:
        names = ", ".join(body.moved)
        say(f"{names} started in the initial state in another relay process", "yellow")
    if body.warnings:
        say(counted(len(body.warnings), "warning"), "yellow")
    say_deadline(body.confirm_by, "monitor")
    for word, idle, command in (
        ("disabled", body.disabled, "rosrv monitor enable"),
        ("in shadow mode", body.shadow, enforce),
    ):
        if idle:
            say(f"{word}: {', '.join(idle)}; {command} {' '.join(idle)}", "yellow")
    say_held(body.held)


def say_shadow_deadline(confirm_by: float | None) -> None:
    if confirm_by is not None:
        say(f"back to shadow mode at {moment(confirm_by)} unless you run: rosrv monitor confirm", "yellow")


def say_held(held: Mapping[str, str]) -> None:
    for name, why in held.items():
        because = why or "its relay process was restarted"
        say(f"{name} holds its topics: {because}; when it is safe: rosrv monitor resume {name}", "red")


def folder_of(appliance: Appliance, loaded: Monitors) -> Path | None:
    """Return the folder of specifications, or None. Over REST it may be on another machine."""
    if loaded.folder is None or appliance.place is not None:
        return None
    return Path(loaded.folder) if Path(loaded.folder).is_dir() else None


def write_specification(
    appliance: Appliance, loaded: Monitors, row: MonitorState, text: str, *, temporary: bool = False
) -> None:
    """Write a guard's file, with its present switch."""
    folder = folder_of(appliance, loaded)
    if folder is None:
        obstacle = "the appliance keeps the text; it has no folder of specifications on this machine"
    elif temporary:
        obstacle = (
            f"the appliance keeps the text; {folder} is not changed by a load that waits for confirmation"
        )
    else:
        try:
            write_where_told(folder / row.file, (with_file_switch(text, row.lasting) or text).encode())
            return
        except OSError as error:
            obstacle = (
                f"the appliance keeps the text, but {folder}/{row.file} is not written: {error.strerror}"
            )
    say_obstacle(appliance, obstacle)


def write_switches(appliance: Appliance, names: Collection[str]) -> None:
    """Write how these monitors are switched into the `preset` statements of their files, those of guards."""
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    for row in loaded.monitors:
        text = (loaded.files or {}).get(row.file, "")
        if row.name in names and with_file_switch(text, row.lasting) is not None:
            _write_switch(appliance, loaded, row, text)


def _write_switch(appliance: Appliance, loaded: Monitors, row: MonitorState, text: str) -> None:
    folder, change = folder_of(appliance, loaded), f"write `{row.lasting}` behind its name in the first line"
    if folder is None:
        why = f"the switch of {row.name} is only in the state directory: {change} of your {row.file}"
    elif loaded.site_keys:
        why = f"the switch of {row.name} is only in the state directory: {change} of {row.file}, and sign it"
    else:
        path = folder / row.file
        try:
            there = read_given_text(path, "utf-8-sig") if path.exists() else text
            new = with_file_switch(there, row.lasting)
            if new is not None and (new != there or not path.exists()):
                write_where_told(path, new.encode())
            return
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            why = f"the switch of {row.name} is only in the state directory, {path} is not written: {reason}; {change}"
    say_obstacle(appliance, why)


def say_obstacle(appliance: Appliance, obstacle: str) -> None:
    if appliance.as_json:
        typer.echo(obstacle, err=True)
    else:
        say(obstacle, "yellow")
