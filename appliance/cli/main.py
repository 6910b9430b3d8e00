"""Define the `rosrv` command: the table of the core's verbs, and the handling of errors that the verbs do not
catch.
"""

import errno
import os
import pkgutil
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import typer

from appliance import __version__
from appliance.base.counted import counted
from appliance.base.engine_thread import InCaller
from appliance.base.log_output import replace_stderr
from appliance.base.user_errors import UserError, with_remedy
from appliance.cli.lazy import application
from appliance.cli.verb_table import Group, Verb, Verbs, merge
from rosmop.tool.terminal import printable

# Ask the three questions of a first contact, and print the next commands: `rosrv` alone on a terminal.


class ContactQuestion(NamedTuple):
    """A question with its answers, of which the first is the default."""

    text: str
    answers: tuple[str, ...]


NODES = ContactQuestion(
    "Where are the ROS nodes?",
    (
        "on this machine",
        "on another machine: this one is beside the robot",
        "nowhere yet: I want to see it at work",
    ),
)
DRIVER = ContactQuestion(
    "Who drives the robot?",
    (
        "programs of the robot itself",
        "people: a gamepad, a browser",
        "also an agent, or other machines",
    ),
)
DENY = ContactQuestion(
    "May it deny calls yet?",
    (
        "no: only record what it would deny",
        "yes",
    ),
)
_INTRODUCTION = "Three questions, and the next command. Nothing is changed. Enter takes 1, Ctrl-C ends.\n"
_AFTER = {
    0: ("rosrv guard suggest", "proposes guards that stop the base when its commands end"),
    1: (
        "rosrv door add NAME",
        "lets a person in with a browser, with rights of their own; then rosrv guard suggest",
    ),
    2: (
        "rosrv policy who-may publish /cmd_vel",
        "lists the hosts that may drive; hosts after `ask` need a person's approval",
    ),
}


def first_contact(read: Callable[[str], str] = input, write: Callable[[str], None] = print) -> int:
    """Ask on the terminal, and return the exit status."""
    try:
        write(_INTRODUCTION)
        nodes = _ask(NODES, read, write)
        if nodes == len(NODES.answers) - 1:
            _say(write, [("sudo rosrv demo", "shows a robot, its operator and an attacker on this machine")])
            return 0
        driver = _ask(DRIVER, read, write)
        deny = _ask(DENY, read, write) == 1
        _say(write, next_commands(nodes, driver, deny=deny))
    except (EOFError, KeyboardInterrupt):
        write("")
        return 1
    return 0


def next_commands(nodes: int, driver: int, *, deny: bool) -> list[tuple[str, str]]:
    """Return commands with what they do, the next one first; the numbers are those of the answers, from 0."""
    master = "http://localhost:11311" if nodes == 0 else "http://ROBOT:11311"
    survey = f"rosrv survey --master {master} --policy draft.ini"
    begins = "sudo rosrv up --policy draft.ini" + ("" if nodes == 0 else " --listen 0.0.0.0:11311")
    how = "and denies what it does not list"
    if not deny:
        how = "and denies nothing: put `audit-only = all` below [Options] first"
    running = ", or see sudo rosrv adopt --check" if nodes == 0 else ""
    return [
        (survey, "lists the robot as it is, and drafts a policy; it registers and changes nothing"),
        (begins, f"takes the place of roscore with this policy, {how}; stop roscore before{running}"),
        _AFTER[driver],
    ]


def _ask(question: ContactQuestion, read: Callable[[str], str], write: Callable[[str], None]) -> int:
    write(question.text)
    for number, answer in enumerate(question.answers, 1):
        write(f"  {number}  {answer}")
    while True:
        text = read("> ").strip() or "1"
        if text.isdecimal() and 1 <= int(text) <= len(question.answers):
            return int(text) - 1
        write(f"write a number from 1 to {len(question.answers)}")


def _say(write: Callable[[str], None], commands: Sequence[tuple[str, str]]) -> None:
    for place, (command, what) in enumerate(commands):
        write(f"\n{'Next' if place == 0 else 'Then'}:  {command}\n       {what}")


_OF_THE_MACHINE = (errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors that an operator can remove, even where a verb does not expect them."""

VERBS: Verbs = {
    "up": Verb("up:up"),
    "status": Verb("status_verb:status"),
    "version": Verb("version:version"),
    "config": Group(
        "Check or show the configuration.",
        {"check": Verb("config_verbs:check"), "show": Verb("config_verbs:show")},
    ),
    "certificate": Verb("certificate_verb:certificate"),
}


def feature_verbs() -> tuple[Verbs, ...]:
    """Import the table of features, which most verbs of the core do not need, and return their verbs."""
    return tuple(tool.verbs for tool in pkgutil.resolve_name("appliance.features.table:TOOLS"))


def all_verbs() -> Verbs:
    return merge(VERBS, *feature_verbs())


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rosrv {__version__}")
        raise typer.Exit


def _global_options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    pass


app = application(
    VERBS,
    further=feature_verbs,
    callback=_global_options,
    panels=True,
    name="rosrv",
    summary="A network-security appliance for ROS 1 robots.",
)


def main() -> None:
    _open_closed_streams()
    replace_stderr(_lost, InCaller, waits=True)  # a note must not end a verb between two of its effects
    sys.argv[1:] = _asking_for_help(_without_old_flags(sys.argv[1:]))
    if not sys.argv[1:] and sys.stdin.isatty() and sys.stdout.isatty():
        sys.exit(first_contact())
    try:
        app()
    except Exception as error:  # noqa: BLE001  the last resort: print the error and its place
        if isinstance(error, UserError):
            sys.stderr.write(f"rosrv: {error}\n")
            sys.exit(1)
        if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE:
            sys.stderr.write(f"rosrv: {printable(with_remedy(error, error.filename or 'output'))}\n")
            sys.exit(2)
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename}:{last.lineno}"
        sys.stderr.write(
            f"rosrv: a defect in rosrv, please report it: {type(error).__name__}: {error} ({where})\n"
        )
        sys.exit(70)


def _lost(lines: int, _since: str) -> str:
    return f"rosrv: {counted(lines, 'line of this output was', 'lines of this output were')} lost\n"


def _open_closed_streams() -> None:
    """Open closed streams (`>&-`), so that no other file gets their descriptors."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdin = sys.stdin or os.fdopen(0)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8")


_OLD_FLAGS = {"-list": "list", "-rvstate": "rvstate", "-enable": "enable", "-disable": "disable"}
"""The flags of the original ROSRV."""


def _without_old_flags(arguments: list[str]) -> list[str]:
    verb = _OLD_FLAGS.get(arguments[0]) if arguments else None
    return arguments if verb is None else ["monitor", verb, *arguments[1:]]


def _asking_for_help(arguments: list[str]) -> list[str]:
    if "help" not in arguments[:2]:
        return arguments
    return [*(word for word in arguments[:2] if word != "help"), *arguments[2:], "--help"]


if __name__ == "__main__":
    main()
