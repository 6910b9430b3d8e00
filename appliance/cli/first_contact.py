"""Ask the three questions of a first contact, and print the next commands: `rosrv` alone on a terminal."""

from collections.abc import Callable, Sequence
from typing import NamedTuple


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
        nodes = _asked(NODES, read, write)
        if nodes == len(NODES.answers) - 1:
            _say(write, [("sudo rosrv demo", "shows a robot, its operator and an attacker on this machine")])
            return 0
        driver = _asked(DRIVER, read, write)
        deny = _asked(DENY, read, write) == 1
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


def _asked(question: ContactQuestion, read: Callable[[str], str], write: Callable[[str], None]) -> int:
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
