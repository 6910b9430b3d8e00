"""Each option in the text of a page exists: of the command beside it, or else of one of the programs."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

from tests.support.command import commands
from tests.unit.cli.test_option_words import OPTIONS
from tests.unit.fleet.test_fleet_options import FLEET

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = ROOT / "docs/reference/generated"
# Options of other programs: the witness, tools of this checkout, Docker, pipx, ROS.
OTHERS = {
    "--device", "--epoch", "--faults", "--global", "--in-sync", "--pair", "--pip-args",
    "--runtime-env-agent-port", "--seed", "--volumes", "--wait",
}  # fmt: skip
KNOWN = (
    {one.name for one in OPTIONS} | {name for _verb, name, _one in FLEET} | {"--help", "--install-completion"}
)
OF_VERB = {
    verb: {"--help", *(word for one in OPTIONS if one.verb == verb for word in one.given.opts)}
    for verb, _command in commands()
}


def _spans() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        if GENERATED in page.parents:
            continue
        text = re.sub(
            r"```.*?```", lambda found: "\n" * found[0].count("\n"), page.read_text(), flags=re.DOTALL
        )
        for span in re.finditer(r"`([^`\n]+)`", text):
            yield f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, span.start()) + 1}", span[1]


def test_an_option_alone_is_one_of_a_program() -> None:
    found = [
        (where, span.split()[0].partition("=")[0]) for where, span in _spans() if re.match("--[a-z]", span)
    ]
    assert len(found) > 100
    assert [(where, option) for where, option in found if option not in KNOWN | OTHERS] == []


def test_an_option_beside_a_command_is_one_of_the_command() -> None:
    wrong, seen = [], 0
    for where, span in _spans():
        if not span.startswith(("rosrv ", "sudo rosrv ")):
            continue
        try:
            words = shlex.split(span.removeprefix("sudo "))[1:]
        except ValueError:
            words = span.removeprefix("sudo ").split()[1:]
        if words[0].startswith("--"):  # of the program itself
            continue
        verb = next((name for size in (3, 2, 1) if (name := " ".join(words[:size])) in OF_VERB), None)
        given = {word.partition("=")[0] for word in words if re.match("--[a-z]", word)}
        seen += bool(given)
        if given and (verb is None or not given <= OF_VERB[verb]):
            wrong.append(f"{where}: {span}: {given - OF_VERB.get(verb or '', set())}")
    assert seen > 60
    assert wrong == []


def test_the_changelog_has_no_fact_twice() -> None:
    """Two bullets of a release with mostly the same words are the same fact, as after a merge."""
    release = (ROOT / "CHANGELOG.md").read_text().partition("## [Unreleased]")[2].partition("\n## [")[0]
    bullets = [" ".join(one.split()) for one in re.findall(r"^- (.*(?:\n  .*)*)", release, re.MULTILINE)]
    words = [frozenset(re.findall(r"[\w.-]+", re.sub(r"\]\([^)]*\)", "]", one.lower()))) for one in bullets]
    twice = [
        (bullets[first], bullets[second])
        for first in range(len(words))
        for second in range(first)
        if len(words[first] & words[second]) > 0.6 * len(words[first] | words[second])
    ]
    assert len(bullets) > 10
    assert twice == []
