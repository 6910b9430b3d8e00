"""Tests of `rosrv token` where no appliance is needed; tests/integration/api has the rest."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app


def run(*arguments: str) -> tuple[int, str]:
    """Exit status, and everything that was said."""
    done = CliRunner().invoke(app, ["token", *arguments])
    return done.exit_code, done.output


@pytest.mark.parametrize("expires", ["", "soon", "0d", "5", "-1d", "1y", "1e9d"])
def test_a_time_that_is_none_is_told(expires: str, tmp_path: Path) -> None:
    """Exit status 2, and what can be written."""
    status, said = run("add", "alice", f"--expires={expires}", "--state", str(tmp_path))
    assert status == 2
    assert "write 30m, 12h, 90d or 52w" in said


@pytest.mark.parametrize("arguments", [("add", "alice"), ("list",), ("revoke", "alice")])
def test_without_an_appliance_it_says_so(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """Exit status 2, and how to start one."""
    status, said = run(*arguments, "--state", str(tmp_path))
    assert status == 2
    assert "rosrv up" in said


def test_a_role_that_is_none_is_told(tmp_path: Path) -> None:
    """The message has the roles that there are."""
    status, said = run("add", "alice", "--role", "root", "--state", str(tmp_path))
    assert status == 2
    assert "viewer" in said
