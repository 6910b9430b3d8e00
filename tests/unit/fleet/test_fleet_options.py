"""The options of `rosrv-fleet` have the names and the kinds of values of `rosrv`'s."""

import contextlib
import io
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from rosrv_fleet.cli import app
from rosrv_fleet.rollouts import commands
from rosrv_fleet.rollouts.machine import HealthGates
from typer.testing import CliRunner

from tests.unit.cli.test_option_words import DURATIONS, MEANINGS, OPTIONS, POINTS

# Names with another kind of value than in `rosrv`, where it is another thing.
OTHER_THINGS = {
    "--key": {"FILE"},
    "--appliance": {"NAME"},  # one appliance of a pair; in `rosrv` the appliance's address
    "--group": {"SITE/GROUP"},
    "--keep": {""},  # a number of bundles
    "--robot": {""},  # a name; in `rosrv` an address
    "--role": {""},
}
OWN_DURATIONS = {"--healthy", "--ring-within"}


def _commands(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if not hasattr(command, "commands"):
        yield name.strip(), command
    for inner, one in getattr(command, "commands", {}).items():
        yield from _commands(one, f"{name} {inner}")


FLEET = [
    (verb, max(param.opts, key=len), param)
    for verb, command in _commands(typer.main.get_command(app))
    for param in command.params
    if param.param_type_name == "option" and param.name != "help" and not param.hidden
]


def test_commands_are_found() -> None:
    assert len(FLEET) > 80


def test_times_are_time_and_lengths_of_time_are_duration() -> None:
    for verb, name, one in FLEET:
        assert (name in POINTS) is (one.metavar == "TIME"), (verb, name)
        assert (name in DURATIONS | OWN_DURATIONS) is (one.metavar == "DURATION"), (verb, name)


def test_no_time_is_a_bare_number() -> None:
    numbers = {name for _verb, name, one in FLEET if one.metavar is None and type(one.default) is float}
    assert numbers == {"--share", "--tolerance"}  # shares


def test_a_written_file_is_the_output() -> None:
    for verb, name, one in FLEET:
        writes = one.help.startswith(("File (", "File for", "Write", "Draw"))
        assert (name == "--output") is writes, (verb, name)
        assert (name == "--output") is ("-o" in one.opts), (verb, name)


def test_consent_has_one_name() -> None:
    for verb, name, one in FLEET:
        assert (name == "--yes") is one.help.startswith("Do not ask"), (verb, name)
        assert name not in {"--confirm", "--again", "--wait", "--days", "--hours", "--seconds"}, (verb, name)


def test_help_is_a_phrase_without_a_full_stop() -> None:
    assert [(verb, name) for verb, name, one in FLEET if not one.help or one.help.endswith(".")] == []


def test_an_option_of_both_programs_has_one_kind_of_value() -> None:
    both = defaultdict(set)
    for option in OPTIONS:
        both[option.name].add(option.metavar)
    for _verb, name, one in FLEET:
        if name in both and name not in MEANINGS:
            found = {one.metavar or ""}
            assert found <= both[name] | OTHER_THINGS.get(name, set()), (name, found, both[name])


def started(monkeypatch: pytest.MonkeyPatch, *options: str) -> dict[str, float]:
    """Return the gates of the request that `rollout start` with these options makes."""
    requests: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def answer(*_connection: object, json: dict[str, Any], **_texts: str) -> Iterator[io.StringIO]:
        requests.append(json)
        yield io.StringIO('{"site": "a", "group": "b", "rollout": null, "robots_known": 0, "conditions": {}}')

    monkeypatch.setattr(commands, "answer_to", answer)
    done = CliRunner().invoke(app, ["rollout", "start", "a/b/1.tar", "--collector", "https://x", *options])
    assert done.exit_code == 0, done.output
    return dict(requests[0]["gates"])


def test_a_rollout_starts_with_the_gates_that_the_page_names(monkeypatch: pytest.MonkeyPatch) -> None:
    gates = started(monkeypatch)
    assert gates == {name: getattr(HealthGates(), name) for name in gates}
    given = started(
        monkeypatch, "--share", "0.5", "--tolerance", "0.1", "--healthy", "2m", "--ring-within", "26h"
    )
    assert given == {"share": 0.5, "tolerance": 0.1, "healthy_seconds": 120.0, "ring_seconds": 93_600.0}
