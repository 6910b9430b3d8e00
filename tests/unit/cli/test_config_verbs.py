import json
from pathlib import Path

import jsonschema_rs
import pytest
import yaml

from appliance.store.state_file import MonitorRevisionRow, StateStore
from tests.support.command import rosrv
from tests.support.engines import InlineDatabase


def test_the_schema_accepts_only_known_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    schema = jsonschema_rs.validator_for(json.loads(rosrv("config", "show", "--schema").stdout))
    assert schema.is_valid(yaml.safe_load(rosrv("config", "show").stdout))
    assert not schema.is_valid({"listn": "x"})


NO_NAMES = (
    "rosrv: api_names: other machines may connect, but only by address or this machine's own name: list the name that"
    " they use"
)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("api_networks: [10.0.0.0/24]\n", [NO_NAMES]),
        ("api_networks: [10.0.0.0/24]\napi_names: [lift-7]\n", []),
        ("api_networks: [10.0.0.0/24]\nname: lift-7\n", []),
        ("{}\n", []),
    ],
)  # fmt: skip
def test_rest_for_other_machines_without_a_name_is_named(
    text: str, named: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "appliance.yaml").write_text(text)
    done = rosrv("config", "check")
    assert (done.returncode, done.stderr.splitlines()) == (0, named)


def test_guards_of_before_0_4_are_named_in_the_folder_and_in_the_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "monitors").mkdir()
    (tmp_path / "state" / "control").mkdir(parents=True)
    former = "// preset sane 1: command=/cmd_vel geometry_msgs/Twist\n"
    (tmp_path / "monitors" / "sane.rv").write_text(former)
    (tmp_path / "monitors" / "other.rv").write_text("// a preset of ours\n")
    store = StateStore(tmp_path / "state" / "control", failed=pytest.fail, kind=InlineDatabase)
    sources = json.dumps({"files": {"cap.rv": former}})
    store.save_monitor_revision(MonitorRevisionRow(1, sources, 0.0, "eve", ""))
    (tmp_path / "appliance.yaml").write_text("monitors: monitors\nstate: state\n")
    done = rosrv("config", "check")
    store.close()
    assert (done.returncode, done.stdout) == (0, "The configuration is valid.\n")
    said = "a guard of a release before 0.4, here only a monitor: while 0.4 serves, run rosrv guard upgrade"
    assert done.stderr.splitlines() == [f"rosrv: cap.rv: {said}", f"rosrv: sane.rv: {said}"]
