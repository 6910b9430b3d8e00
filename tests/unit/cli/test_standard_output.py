"""The value `-` of an option that names a file: standard output, or a refusal, in all verbs alike."""

from pathlib import Path

import pytest

from appliance.cli.output import OR_STANDARD
from tests.support.command import rosrv
from tests.unit.cli.test_option_limits import _arguments
from tests.unit.cli.test_option_words import OPTIONS, SECOND_OUTPUTS

WRITE = sorted(
    (one.verb, one.name)
    for one in OPTIONS
    if one.name == "--output" or (one.verb, one.name) in SECOND_OUTPUTS
)
OFFER = sorted((one.verb, one.name) for one in OPTIONS if OR_STANDARD in one.help)


def test_each_verb_offers_standard_output_for_its_file() -> None:
    assert set(OFFER) <= set(WRITE)
    files_only = {verb for verb, name in set(WRITE) - set(OFFER) if name == "--output"}
    # One is a folder, the others are several files, or their writers seek.
    assert files_only == {"standby join", "demo", "monitor run", "monitor learn"}


@pytest.mark.parametrize(("verb", "option"), WRITE)
def test_no_verb_makes_a_file_of_that_name(
    verb: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*verb.split(), *_arguments(verb, option), option, "-"]
    if (verb, option) in OFFER:
        expected = f"{option} - and --json both use standard output: give one"
        words.append("--json")
    else:
        expected = f"{option} - is not the name of a file: give one"
    done = rosrv(*words, ROSRV_STATE=str(tmp_path))
    assert (done.returncode, expected in done.stderr, list(tmp_path.iterdir())) == (2, True, []), done
