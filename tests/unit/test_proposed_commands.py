"""Each command that the product proposes, in errors, hints, help and the console, is one that it accepts."""

import ast
import functools
import itertools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from rosrv_fleet.cli import app as fleet_app

from appliance.cli import main
from distribution import fact_cache
from distribution.fact_cache import facts_of_files, nodes
from rosmop.tool.command import app as rosmop_app
from tests.support.sources import LANGUAGE_TESTS, ROOT

_UsageError: Any = typer.BadParameter.__mro__[1]  # which typer does not export
GIVEN = "\x01"  # a value that the program fills in
_WORD = r"(?:\\?\"[^\"\n]*\"|'[^'\n]*'|[^\s`\"';()<>|,&]|,(?=\S))+"
_PROPOSED = re.compile(rf"(?<![\w./-])(rosrv-fleet|rosrv|rosmop) ([a-z][a-z-]*(?: {_WORD})*(?: (?=[\"']))?)")
_OF_PAGES = re.compile(
    r"(?:^ *(?:sudo |\$ )?|`(?:sudo )?)((?:rosrv|rosrv-fleet|rosmop) [a-z-][^`\n]*)", re.MULTILINE
)
SAMPLES = ("base", "1", "10.0.0.9", "/topic", "1h", "enabled", "f.yaml", "x=1")
NAMED = {
    "TIME": "1h", "FILE": "f.ini", "ADDRESS": "10.0.0.9", "PORT": "9091", "NUMBER": "1", "N": "1", "A": "state",
    "B": "other",
}  # fmt: skip
PROSE = {
    "again", "on", "says", "shows", "there", "and", "or", "names", "of", "first", "for", "with", "is", "to", "has",
    "if", "in", "reports", "as", "gives", "must", "until", "then", "lists", "before", "would", "does", "while", "both",
    "prints", "without", "cannot", "ends", "at",
}  # fmt: skip
APPLICATIONS = {"rosrv": main.app, "rosrv-fleet": fleet_app, "rosmop": rosmop_app}
LABELS = re.compile(r"(audit checkpoint|audit removal|order|evidence|fleet receipt|signing key)( .*)?$")
"""The first lines of signed statements, which are not commands."""


def texts(file: Path) -> Iterator[str]:
    if file.suffix == ".js":
        text = re.sub(r"<\$\{[^{}]*\}[^<>]*/>", GIVEN, file.read_text())  # a value in an element of its own
        yield re.sub(r"\$\{[^{}]*\}", GIVEN, text)
        return
    within = nodes(ast.parse(file.read_text()))
    inside = {id(part) for node in within if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in within:
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(one.value) if isinstance(one, ast.Constant) else GIVEN for one in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside:
            yield node.value


def proposals() -> dict[str, str]:
    """Return the proposed commands, each with the name of a file that proposes it."""
    found: dict[str, str] = {}
    files = [
        file for folder in ("appliance", "fleet/src", "rosmop") for file in (ROOT / folder).rglob("*.py")
    ]
    files += ROOT.glob("appliance/**/console/**/*.js")
    product = [file for file in files if LANGUAGE_TESTS not in file.parents]
    code = (__file__, fact_cache.__file__)
    for name, proposed in facts_of_files(tuple[str, ...], proposed_by, product, code=code).items():
        for call in proposed:
            found.setdefault(call, Path(name).name)
    return found


def proposed_by(file: Path) -> tuple[str, ...]:
    calls = [each for text in texts(file) for each in _PROPOSED.findall(text)]
    return tuple(
        f"{program} {re.split('[.:] ', f'{call} ')[0].strip().rstrip('.:…')}" for program, call in calls
    )


@functools.cache
def _root(program: str) -> Any:
    return typer.main.get_command(APPLICATIONS[program])


def verb_of(words: list[str]) -> tuple[Any, Any, list[str]] | None:
    """Return the command, its group's context, and the words after its name; None if the words are prose."""
    command: Any = _root(words[0])
    context = command.make_context(words[0], [], resilient_parsing=True)
    for number, word in enumerate(words[1:], start=1):
        if not hasattr(command, "list_commands"):
            return command, context.parent, words[number:]
        command = command.get_command(context, word)
        if command is None:
            return None
        context = command.make_context(word, [], parent=context, resilient_parsing=True)
        command = context.command
    return None if hasattr(command, "list_commands") else (command, context.parent, [])


def values(words: list[str]) -> Iterator[list[str]]:
    """Yield the words with samples in place of what the reader or the program fills in."""
    unknown = [place for place, word in enumerate(words) if GIVEN in word or word.strip("[]").isupper()]
    for chosen in itertools.product(SAMPLES, repeat=min(2, len(unknown))):
        made = list(words)
        for number, place in enumerate(unknown):
            sample = chosen[number % len(chosen)]
            named = NAMED.get(words[place].strip("[]"), sample)
            made[place] = words[place].replace(GIVEN, sample) if GIVEN in words[place] else named
        yield [word for word in made if word]


def accepted(words: list[str]) -> str:
    """Return why the program does not accept the words, or an empty string. A sentence may go on after a command."""
    found = verb_of(words)
    if found is None:
        return "no such command"
    command, parent, arguments = found
    arguments = [word for word in arguments if word != "…"]
    prose = next((place for place, word in enumerate(arguments) if word in PROSE), len(arguments))
    arguments = arguments[:prose]
    if all(word.startswith("--") for word in arguments):  # it is named, perhaps with an option
        context = command.make_context(words[0], [], parent=parent, resilient_parsing=True)
        options = {
            one
            for each in command.get_params(context)
            for one in (*each.opts, *each.secondary_opts, "--help")
        }
        return ", ".join(word for word in arguments if word.partition("=")[0] not in options)
    wrong = ""
    for given in values(arguments):
        try:
            command.make_context(words[0], list(given), parent=parent)
        except (_UsageError, typer.Exit, SystemExit) as error:
            wrong = wrong or f"{error}" or type(error).__name__
        else:
            return ""
    return wrong


@pytest.fixture(autouse=True)
def collector(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROSRV_FLEET_COLLECTOR", "https://10.0.0.9:8450")  # as its pages ask for
    monkeypatch.setenv("ROSRV_FLEET_CA", "ca.pem")
    monkeypatch.setenv("ROSRV_FLEET_TOKEN_FILE", "token")


def test_each_proposed_command_is_accepted() -> None:
    found = proposals()
    wrong = [
        f"{file} proposes: {proposal}: {why}" for proposal, file in found.items() if (why := _wrong(proposal))
    ]
    assert len(found) > 200 and not wrong, "\n".join(wrong)


def test_each_command_of_a_page_is_accepted() -> None:
    wrong, seen = [], 0
    for page in (*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "SECURITY.md"):
        for call in _OF_PAGES.findall(page.read_text().replace("\\\n", " ")):
            if "\u2026" in call or len(shlex.split(call)) == 2:  # shortened, or the name of a group
                continue
            seen += 1
            given = shlex.split(call, comments=True)
            words = list(itertools.takewhile(lambda word: word not in {"|", ">", "&&", ";"}, given))
            wrong += [f"{page.name}: {call}: {why}"] if (why := accepted(words)) else []
    assert seen > 300 and not wrong, "\n".join(wrong)


def _wrong(proposal: str) -> str:
    words = shlex.split(proposal)
    if verb_of(words) is None and (len(words) == 2 or words[1] in PROSE or LABELS.match(" ".join(words[1:]))):
        return ""  # a group, prose or a label
    return accepted(words)
