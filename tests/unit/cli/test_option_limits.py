"""Each duration has a maximum, and each option beside `--dry-run` changes what the dry run reports, or is refused."""

from pathlib import Path

import pytest
from typer.core import TyperArgument

from tests.support.command import commands, rosrv
from tests.unit.cli.test_option_words import NO_TIME, OPTIONS

_LONGER_THAN_ALL = "99999d"
_OUTPUT = {"--json", "--output", "--state", "--api", "--api-ca", "--insecure", "--help", "--dry-run"}
# Options that change what the dry run of a verb reports.
REPORTED = {
    "guard new": {"--by", "--topic", "--type", "--name", "--shadow", "--hold"},
    "guard set": {"--since", "--hold"},
    "guard upgrade": {"--topic", "--hold"},
    "guard enforce": set(),
    "host block": {"--for", "--note", "--force"},
    "policy enforce": {"--since"},
}
# Options that change nothing in a dry run, with a value that may be given. `--within` belongs to `--when-standing`.
REFUSED = {"--confirm-within": ["5m"], "--when-standing": []}
_WORDS = {"PARAMETER=VALUE": "silent=1", "NUMBER": "1"}
_BESIDE = {("status", "--every"): ["--watch"], ("standby status", "--every"): ["--watch"]}
_NEED_ALL = {"approve"}  # its option needs an argument that is optional otherwise


def _arguments(verb: str, given: str) -> list[str]:
    """Return a command line of the verb with its required arguments and options, except the option `given`."""
    command = dict(commands())[verb]
    words: list[str] = list(_BESIDE.get((verb, given), []))
    for param in command.params:
        if isinstance(param, TyperArgument) and (param.required or verb in _NEED_ALL):
            words.append(_WORDS.get((param.metavar or param.name or "").strip("[]{}.…").upper(), "x"))
        elif param.required and given not in param.opts:
            words += [max(param.opts, key=len), "x"]
    return words


DURATIONS = sorted(
    (option.verb, option.name)
    for option in OPTIONS
    if option.metavar == "DURATION" and (option.verb, option.name) not in NO_TIME
)


def test_durations_are_found() -> None:
    assert len(DURATIONS) > 30


@pytest.mark.parametrize(("verb", "option"), DURATIONS)
def test_a_duration_has_a_maximum(verb: str, option: str, tmp_path: Path) -> None:
    """The maximum is checked before the appliance is asked: none runs here."""
    words = _arguments(verb, option)
    done = rosrv(*verb.split(), *words, option, _LONGER_THAN_ALL, ROSRV_STATE=str(tmp_path))
    assert (done.returncode, f"{option} {_LONGER_THAN_ALL} is out of bounds: write " in done.stderr) == (
        2,
        True,
    ), done


def test_each_option_beside_a_dry_run_is_reported_or_refused() -> None:
    found = {
        verb: {one.name for one in OPTIONS if one.verb == verb} - _OUTPUT - set(REFUSED) - {"--within"}
        for verb in {option.verb for option in OPTIONS if option.name == "--dry-run"}
    }
    assert found == REPORTED


@pytest.mark.parametrize(
    ("verb", "option"),
    sorted((one.verb, one.name) for one in OPTIONS if one.verb in REPORTED and one.name in REFUSED),
)
def test_an_option_without_effect_in_a_dry_run_is_refused(verb: str, option: str, tmp_path: Path) -> None:
    words = [*_arguments(verb, option), "--dry-run", option, *REFUSED[option]]
    done = rosrv(*verb.split(), *words, ROSRV_STATE=str(tmp_path))
    assert done.returncode == 2
    assert f"{option} has no effect with --dry-run: leave one of them out" in done.stderr


def test_a_time_of_the_dry_run_needs_it(tmp_path: Path) -> None:
    done = rosrv("guard", "set", "speed", "vMax=1", "--since", "2h", ROSRV_STATE=str(tmp_path))
    assert (done.returncode, "--since goes with --dry-run" in done.stderr) == (2, True)
