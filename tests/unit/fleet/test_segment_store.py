import gzip
from pathlib import Path

import pytest
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore

from appliance.audit.proof.copies import SignedCheckpoint
from appliance.base.clock import wall_ns
from appliance.formats.segments import SegmentHeader, SegmentSummary
from tests.support.virtual_clock import let_time_pass

_LOG = "0" * 32


class Robot:
    """Uploads segments without records."""

    def __init__(self, folder: Path) -> None:
        self.store = SegmentStore(folder, 0)
        self._upload = folder / "upload"

    def push(self, number: int) -> SegmentPlace:
        end = SignedCheckpoint(_LOG, number, number, "a" * 64, 0, "b" * 64, "", "")
        header = SegmentHeader(begin=None, end=end)
        self._upload.unlink(missing_ok=True)
        self._upload.write_bytes(gzip.compress(header.line()))
        return self.store.keep("arm7", self._upload, SegmentSummary(f"{number:064}", header, 0, 0), 1)

    def newest(self) -> int:
        newest = self.store.newest("arm7")
        assert newest is not None
        return newest[1].number


def test_a_repeated_upload_completes_the_work_of_a_killed_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The health of a robot shows its newest segment, even if the collector was killed before it noted it."""
    robot, places = Robot(tmp_path), {}
    for number in (1, 2):
        places[number] = robot.push(number)
        let_time_pass(10)

    def killed(*_place: object) -> None:
        raise OSError("killed")

    monkeypatch.setattr(SegmentStore, "_note_newest", killed)
    with pytest.raises(OSError, match="killed"):
        robot.push(3)
    monkeypatch.undo()
    assert robot.newest() == 2
    found = robot.store.numbered("arm7", _LOG, 3)[0]
    let_time_pass(10)
    robot.store.settle(found, robot.store.header(found))
    assert robot.newest() == 3
    noted = wall_ns()
    let_time_pass(10)
    robot.store.settle(places[1], robot.store.header(places[1]))
    assert robot.store.newest("arm7") == (noted, found)
