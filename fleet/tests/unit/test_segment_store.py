from pathlib import Path

import pytest
from rosrv_fleet.segment_store import SegmentStore

from appliance.base.clock import wall_ns
from fleet.tests.support.collectors import upload
from tests.support.virtual_clock import let_time_pass

_LOG = "0" * 32


def newest(store: SegmentStore) -> int:
    newest = store.newest("arm7")
    assert newest is not None
    return newest[1].number


def test_a_repeated_upload_completes_the_work_of_a_killed_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The health of a robot shows its newest segment, even if the collector was killed before it noted it."""
    store, places = SegmentStore(tmp_path, 0), {}
    for number in (1, 2):
        places[number] = upload(store, number)
        let_time_pass(10)

    def killed(*_place: object) -> None:
        raise OSError("killed")

    monkeypatch.setattr(SegmentStore, "_note_newest", killed)
    with pytest.raises(OSError, match="killed"):
        upload(store, 3)
    monkeypatch.undo()
    assert newest(store) == 2
    found = store.with_number("arm7", _LOG, 3)[0]
    let_time_pass(10)
    store.settle(found, store.header(found))
    assert newest(store) == 3
    noted = wall_ns()
    let_time_pass(10)
    store.settle(places[1], store.header(places[1]))
    assert store.newest("arm7") == (noted, found)
