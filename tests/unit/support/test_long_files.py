import subprocess
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[2]


def test_every_long_file_exists() -> None:
    names = (TESTS / "long.txt").read_text(encoding="utf-8").splitlines()
    assert [name for name in names if not name.startswith("#") and not (TESTS.parent / name).is_file()] == []


@pytest.mark.nightly
def test_rules_on_the_source_run_with_make_check() -> None:
    """They are slow, but a commit that passes `make check` must not fail in CI because of a word in a comment."""
    command = subprocess.run(
        ["make", "--dry-run", "unit"], cwd=TESTS.parent, capture_output=True, text=True, check=True
    ).stdout
    ignored = [word for word in command.split() if word.startswith("--ignore=")]
    assert "--ignore=tests/unit/audit/log/test_log.py" in ignored
    rules = ("--ignore=tests/unit/test_", "--ignore=tests/unit/support/")
    assert [word for word in ignored if word.startswith(rules)] == []
