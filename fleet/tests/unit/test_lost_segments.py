import shutil
from pathlib import Path

import pytest
from rosrv_fleet.cli import app
from rosrv_fleet.segment_store import SegmentStore
from typer.testing import CliRunner, Result

from fleet.tests.support.collectors import upload
from fleet.tests.support.enrolled_robots import enrolled_robots


@pytest.fixture
def store(tmp_path: Path) -> SegmentStore:
    enrolled_robots(tmp_path, "arm7")
    (tmp_path / "fleet.yaml").write_text(f"data: {tmp_path}\n")
    return SegmentStore(tmp_path, 0)


def _verify(folder: Path) -> Result:
    return CliRunner().invoke(app, ["verify", "arm7", "--config", str(folder / "fleet.yaml")])


@pytest.mark.usefixtures("store")
def test_a_robot_without_segments_lost_nothing(tmp_path: Path) -> None:
    done = _verify(tmp_path)
    assert (done.exit_code, "nothing was collected yet" in done.output) == (0, True)


@pytest.mark.parametrize("whole", [True, False], ids=["the whole log", "its end"])
def test_a_lost_newest_segment_is_found(whole: bool, store: SegmentStore, tmp_path: Path) -> None:
    places = [upload(store, number) for number in (1, 2)]
    assert "is missing" not in _verify(tmp_path).output
    if whole:
        shutil.rmtree(tmp_path / "segments" / "arm7")
    else:
        store.path(places[1]).unlink()
    done = _verify(tmp_path)
    assert done.exit_code == 1
    assert "segment 2, the newest that arrived, is missing" in done.output
