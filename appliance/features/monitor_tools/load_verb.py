"""The command `rosrv monitor load`."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.validation_messages import shape_of
from appliance.channel import admin
from appliance.channel.admin import AdminAnswer
from appliance.channel.rest_bodies import DEFINITION, FILE_NAME, LONGEST_TEXT
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.monitor_changes import Hold, say_replaced
from appliance.cli.monitor_program import MONITOR
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.features.monitor_tools.in_force import Force, Shadow, given_to_monitors
from appliance.specifications.specification_files import Sources, signatures_of
from rosmop.form.findings import Position, SpecificationError
from rosmop.tool.specification_input import definition_folders, definition_texts, read_specifications
from rosmop.tool.terminal import printable

# Read specifications and message definitions to send them to the appliance.

_NOT_UTF_8 = re.compile("[\udc80-\udcff]")
_SAVE_AS_UTF_8 = "these bytes are not UTF-8; save the file as UTF-8"
_STRING_CONSTANT = re.compile(r"\s*string\s+\w+\s*=")  # its value extends to the end of the line


def read_to_send(files: Sequence[Path], folders: Sequence[Path]) -> Sources:
    """Return the sources to send, from the files that `read_specifications` and `read_definitions` accept.

    Raises `SpecificationError`.
    """
    named: dict[str, Path] = {}
    for file in files:
        other = named.setdefault(file.name, file)
        if os.path.realpath(other) != os.path.realpath(file):
            raise MONITOR.usage_error(
                f"{other} and {file} have the same file name, by which the appliance identifies specifications; "
                "rename one of them"
            )
    definitions: dict[str, str] = {}
    for folder in definition_folders(MONITOR, files, folders):
        texts, places = definition_texts(MONITOR, folder)
        definitions |= {name: _sendable(text, places[name]) for name, text in texts.items()}
        named |= {name: Path(places[name]) for name in texts}
    texts = read_specifications(MONITOR, files)
    for path, text in texts.items():
        match = _NOT_UTF_8.search(text)
        if match is not None:
            line = text.count("\n", 0, match.start()) + 1
            column = match.start() - text.rfind("\n", 0, match.start())
            raise SpecificationError.at(Position(path, line, column), _SAVE_AS_UTF_8)
    sent = {Path(path).name: text for path, text in texts.items()}
    forms = ((sent, FILE_NAME), (definitions, DEFINITION))
    for name, text, form in ((name, text, form) for found, form in forms for name, text in found.items()):
        position = Position(str(named[name]), 1, 1)
        if not re.fullmatch(form, name):
            raise SpecificationError.at(position, f"{name} must be {shape_of(form)}: rename it")
        if len(text) > LONGEST_TEXT:
            raise SpecificationError.at(position, f"longer than {LONGEST_TEXT} characters: divide it")
    return Sources(sent, definitions, signatures_of(named))


def _sendable(text: str, place: str) -> str:
    """Replace invalid UTF-8 in a definition's comments, and reject it elsewhere."""
    lines = text.split("\n")
    for number, line in enumerate(lines):
        if line.isascii() or not _NOT_UTF_8.search(line):
            continue
        content = line if _STRING_CONSTANT.match(line) else line.partition("#")[0]
        if _NOT_UTF_8.search(content):
            raise SpecificationError.at(Position(place, number + 1, 1), _SAVE_AS_UTF_8)
        lines[number] = _NOT_UTF_8.sub("\N{REPLACEMENT CHARACTER}", line)
    return "\n".join(lines)


@speaks
def load(
    appliance: Appliance,
    files: Annotated[
        list[Path],
        typer.Argument(readable=False, metavar="FILE", help="Specification files (.rv)", show_default=False),
    ],
    msg: Annotated[
        list[Path] | None,
        typer.Option("--msg", metavar="DIR", help="Folder of message definitions (repeatable)"),
    ] = None,
    *,
    note: Annotated[str, typer.Option(help="Reason, kept with the revision")] = "",
    confirm_within: ConfirmWithin = None,
    shadow: Shadow = False,
    force: Force = False,
    hold: Hold = False,
    given: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="MONITOR.NAME=VALUE",
            help="Constant or topic in the `given` of a specification (repeatable)",
        ),
    ] = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Load specifications while the robot runs; files of the same name are replaced.

    They are compiled and compared with the robot's topics first. After an error nothing changes: exit status 1. A
    monitor whose source changes loses its state; if it then holds topics with traffic, the load needs --hold.
    Message definitions come from `msg/` beside the files and from --msg.

    Example: rosrv monitor load safe_zone.rv --shadow
    """
    confirmed = seconds_within(confirm_within, "monitor")
    try:
        sent = read_to_send(files, msg or [])
    except SpecificationError as error:
        found = [printable(str(finding)) for finding in error.findings]
        appliance.body_or_exit(AdminAnswer(False, error="nothing was sent", findings=found))
        return
    order = admin.MonitorLoad(
        sent.files,
        sent.definitions,
        note,
        confirm_within=confirmed,
        signatures=sent.signatures,
        force=force,
        shadow=shadow,
        hold=hold,
        given=given_to_monitors(given or []),
    )
    if when_standing:
        stand_or_exit(appliance, within, "rosrv monitor")
    say_replaced(appliance.answer_or_exit(order))
