import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.store.state_file import EndRow, MonitorRevisionRow, StateStore
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import StateDirectory
from tests.support.engines import InlineDatabase


def state_with(tmp_path: Path, who: str) -> Path:
    home = tmp_path / "control"
    home.mkdir()
    store = StateStore(home, failed=print, kind=InlineDatabase)
    store.save_monitor_revision(MonitorRevisionRow(7, '{"files": {"a.rv": "old"}}', 0.0, who, ""))
    store.save_end(EndRow("confirm monitors", "6", 1, 0, 0, None))
    store.close()
    return tmp_path


def reset(state: Path, *options: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["monitor", "reset", "--state", str(state), *options])
    if isinstance(result.exception, StartError):
        return 1, str(result.exception)
    return result.exit_code, result.output


def last(state: Path) -> tuple[MonitorRevisionRow, list[str]]:
    """Return the last revision, and to which revisions it goes back without a confirmation."""
    store = StateStore(state / "control", failed=print, kind=InlineDatabase)
    try:
        return store.monitor_revisions(1)[0], [end.name for end in store.ends()]
    finally:
        store.close()


@pytest.mark.nightly
def test_specifications_loaded_by_command_are_dropped(tmp_path: Path) -> None:
    state = state_with(tmp_path, "operator")
    assert json.loads(reset(state, "--json")[1]) == {"given_up": 7}
    row, back_to = last(state)
    assert (row.revision, row.who, back_to) == (8, "disk", [])
    status, said = reset(state)
    assert status == 0
    assert "nothing to discard" in said


@pytest.mark.nightly
def test_a_running_appliance_is_left_alone(tmp_path: Path) -> None:
    state = state_with(tmp_path, "operator")
    running = StateDirectory(state)
    status, said = reset(state)
    running.close()
    assert status == 1
    assert "already uses the state directory" in said
    assert last(state) == (MonitorRevisionRow(7, '{"files": {"a.rv": "old"}}', 0.0, "operator", ""), ["6"])


def test_a_directory_without_a_state_is_an_error(tmp_path: Path) -> None:
    status, said = reset(tmp_path / "nowhere")
    assert status == 2
    assert "--state" in said
    assert not (tmp_path / "nowhere").exists()
