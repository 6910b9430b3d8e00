"""Tests of `appliance.cli.config_verbs`, as a user would type it."""

import json
import subprocess
import sys
from pathlib import Path

import jsonschema_rs
import yaml

ROSRV = str(Path(sys.executable).parent / "rosrv")


def rosrv(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command in a directory, with an empty environment."""
    return subprocess.run([ROSRV, *arguments], cwd=cwd, env={}, capture_output=True, text=True, check=False)


def test_check_tells_every_mistake_without_a_traceback(tmp_path: Path) -> None:
    """Exit status 1 and one line for each mistake."""
    (tmp_path / "appliance.yaml").write_text("listn: x\nrelays: 0\n")
    done = rosrv("config", "check", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines()[0] == "rosrv: appliance.yaml:1: unknown key listn: did you mean listen?"
    assert "appliance.yaml:2: relays: " in done.stderr
    assert "Traceback" not in done.stderr
    (tmp_path / "appliance.yaml").rename(tmp_path / "other.yaml")
    assert "other.yaml:2: relays: " in rosrv("config", "check", "other.yaml", cwd=tmp_path).stderr
    (tmp_path / "other.yaml").rename(tmp_path / "appliance.yaml")
    as_json = rosrv("config", "check", "--json", cwd=tmp_path)
    assert [json.loads(line)["place"] for line in as_json.stdout.splitlines()] == [
        "appliance.yaml:1",
        "appliance.yaml:2",
    ]
    assert as_json.returncode == 1


def test_check_says_when_all_is_right(tmp_path: Path) -> None:
    """Exit status 0."""
    done = rosrv("config", "check", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "The configuration is right.\n")


def test_what_show_prints_can_be_read_back(tmp_path: Path) -> None:
    """The output is a configuration file that says the same, in YAML and in JSON."""
    shown = rosrv("config", "show", cwd=tmp_path).stdout
    (tmp_path / "appliance.yaml").write_text(shown)
    assert rosrv("config", "show", cwd=tmp_path).stdout == shown
    assert json.loads(rosrv("config", "show", "--json", cwd=tmp_path).stdout) == yaml.safe_load(shown)


def test_the_schema_knows_right_from_wrong(tmp_path: Path) -> None:
    """An editor that uses the schema accepts what we accept and refuses an unknown key."""
    schema = jsonschema_rs.validator_for(json.loads(rosrv("config", "show", "--schema", cwd=tmp_path).stdout))
    assert schema.is_valid(yaml.safe_load(rosrv("config", "show", cwd=tmp_path).stdout))
    assert not schema.is_valid({"listn": "x"})
