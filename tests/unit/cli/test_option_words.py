"""One name and one metavar for a time, for output and for consent, in all verbs."""

import re
from collections import defaultdict
from typing import Any, NamedTuple

import typer
from typer.core import TyperArgument, TyperOption

from appliance.cli.main import app
from tests.support.command import commands

POINTS = {"--since": "TIME", "--until": "TIME", "--at": "TIME", "--between": "TIME TIME"}
DURATIONS = {"--for", "--within", "--confirm-within", "--every", "--grace", "--before", "--after"}
NO_TIME = {("audit checkpoints", "--after"), ("report interventions", "--after")}  # a number, and a report
# Only these flags let a command do what it would refuse. `--hold` is beside `--force`, so that an operator who
# accepts one consequence has not accepted the other.
EVEN = re.compile(r"(Block|Join|Load|Load or enforce|Release) even\b")
CONSENT = {"--force", "--hold"}
# These write a file beside the output of the verb.
SECOND_OUTPUTS = {
    ("survey", "--policy"), ("policy learn", "--tests"), ("monitor check", "--dot"), ("monitor check", "--svg"),
    ("monitor run", "--report"), ("monitor learn", "--report"), ("monitor replay", "--report"),
    ("monitor coverage", "--report"),
}  # fmt: skip
MEANINGS = {
    "--api": {"HOST:PORT", "URL"},  # where `up` listens, and the appliance of all others
    "--after": {"DURATION", "FILE", "N"},
    "--check": {"", "HOST"},  # of `adopt` and of `protect`
    "--other": {"ADDRESS", "DIR"},  # a copy of the other log, and the address of the other appliance
    "--output": {"DIR", "FILE"},
    "--topic": {"TOPIC", "PATTERN", "NAME=TOPIC"},  # one, several, and a topic for a role of a preset
}


class Option(NamedTuple):
    verb: str
    name: str
    metavar: str
    help: str
    given: Any


OPTIONS = [
    Option(name, max(param.opts, key=len), param.metavar or "", param.help or "", param)
    for name, command in commands()
    for param in command.params
    if isinstance(param, TyperOption) and not param.hidden
]


def test_a_point_in_time_is_time_and_a_length_is_duration() -> None:
    for option in OPTIONS:
        if (option.verb, option.name) in NO_TIME:
            continue
        if option.name in POINTS or option.metavar.startswith("TIME"):
            assert option.metavar == POINTS.get(option.name), option
        if option.name in DURATIONS or option.metavar == "DURATION":
            assert (option.name in DURATIONS, option.metavar) == (True, "DURATION"), option


def test_no_time_is_a_bare_number() -> None:
    context = typer.Context(typer.main.get_command(app))
    numbers = {one.name for one in OPTIONS if "float" in (one.given.display_type(context) or "")} - DURATIONS
    assert numbers == {"--hold-out", "--fail-under"}  # shares


def test_a_file_that_a_verb_writes_is_its_output() -> None:
    for option in OPTIONS:
        writes = option.help.startswith(("File for", "File to write", "File,", "File (", "Write", "Draw"))
        if (option.verb, option.name) in SECOND_OUTPUTS:
            assert option.metavar == "FILE", option
        elif option.name == "--output" or (writes and option.metavar in ("FILE", "DIR")):
            assert (option.name, "-o" in option.given.opts) == ("--output", True), option


def test_an_option_that_consents_is_yes_or_force() -> None:
    for option in OPTIONS:
        assert (option.name == "--yes") is option.help.startswith("Do not ask"), option
        assert (option.name in CONSENT) is bool(EVEN.match(option.help)), option


def test_an_option_has_one_metavar_in_all_verbs() -> None:
    found = defaultdict(set)
    for option in OPTIONS:
        found[option.name].add(option.metavar)
    assert {name: kinds for name, kinds in found.items() if len(kinds) > 1} == MEANINGS


def test_an_argument_is_in_capitals() -> None:
    arguments = [one for _, command in commands() for one in command.params if isinstance(one, TyperArgument)]
    assert len(arguments) > 60
    assert [one.name for one in arguments if not one.metavar or one.metavar != one.metavar.upper()] == []


def test_help_of_options_is_a_phrase_without_a_full_stop() -> None:
    assert [option for option in OPTIONS if option.help.endswith(".")] == []
