from pathlib import Path

import pytest

from appliance.base import clock
from appliance.store.state_file import StateStore
from appliance.store.stored_deadlines import StoredDeadlines
from appliance.store.writer_thread import StoreError
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import VirtualClock

WALL = 1_790_000_000.0


def test_a_clock_that_is_set_back_over_a_restart_revives_no_token(tmp_path: Path) -> None:
    machine = VirtualClock(wall=WALL)
    with clock.using(machine):
        store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
        ends = StoredDeadlines(store)
        given = {"ended": WALL + 60.0, "usable": WALL + 3600.0}
        assert not any(ends.passed(name, end) for name, end in given.items())
        machine.advance(600.0)
        ends.save()
        store.close()
    machine = VirtualClock(wall=WALL - 86_400.0, now=5.0)
    with clock.using(machine):
        store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
        ends = StoredDeadlines(store)
        assert {name: ends.passed(name, end) for name, end in given.items()} == {
            "ended": True,
            "usable": False,
        }
        machine.advance(2999.0)
        assert not ends.passed("usable", given["usable"])
        machine.advance(1.0)
        assert ends.passed("usable", given["usable"])
        store.close()


def test_a_full_disk_is_asked_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    ends = StoredDeadlines(store)
    ends.passed("one", clock.wall() + 60.0)

    def full() -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store.database, "require_room", full)
        with pytest.raises(StoreError):
            ends.save()
    assert store.time_left() == {}
    ends.save()
    assert store.time_left().keys() == {"one"}
    store.close()
