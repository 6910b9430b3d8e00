from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.control.operators.switched_off import SwitchedOffWatch
from appliance.store.state_file import StateStore
from tests.support.core import FakeTrail
from tests.support.engines import InlineDatabase


class Scene:
    def __init__(self, store: StateStore) -> None:
        self.store = store
        self.off: dict[str, Any] = {}
        self.until: dict[str, float] = {}
        self.audit_only: set[str] = set()
        self.trail = FakeTrail()

    @property
    def recorded(self) -> list[str]:
        return [f"{record.event}: {record.reason}" for record in self.trail.records]

    def watch(self, forgotten_after: float | None = 3600.0) -> SwitchedOffWatch:
        monitors: Any = SimpleNamespace(
            switches=SimpleNamespace(switched_off=lambda: self.off),
            returns=SimpleNamespace(until=lambda name: self.until.get(name)),  # noqa: PLW0108  of whatever is there then
        )
        policies: Any = SimpleNamespace(
            current=SimpleNamespace(audit_only=lambda category: category.value in self.audit_only)
        )
        return SwitchedOffWatch(monitors, policies, self.store, self.trail, forgotten_after)


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    yield Scene(store)
    store.close()


@pytest.mark.nightly
@pytest.mark.anyio
async def test_a_disabled_monitor_is_an_alarm_once(scene: Scene) -> None:
    scene.off = {"a": False, "b": "shadow"}
    watch = scene.watch()
    watch.look(3000.0)
    assert [row.forgotten for row in watch.rows()] == [False, False]
    await scene.store.settled()
    watch = scene.watch()
    watch.look(700.0)
    assert scene.recorded == [
        "protection forgotten: monitor a is disabled for more than 1.0 h: rosrv monitor enable a",
        "protection forgotten: monitor b is in shadow mode for more than 1.0 h: rosrv monitor enforce b",
    ]
    await scene.store.settled()
    watch = scene.watch()
    watch.look(9000.0)
    assert len(scene.recorded) == 2
    assert [row.forgotten for row in watch.rows()] == [True, True]
    scene.off = {}
    watch.look(60.0)
    scene.off = {"a": False}
    watch.look(60.0)
    assert [row.forgotten for row in watch.rows()] == [False]


def test_a_timed_change_is_not_forgotten(scene: Scene) -> None:
    scene.off, scene.until = {"a": False}, {"a": 1e12}
    watch = scene.watch()
    watch.look(9000.0)
    assert scene.recorded == []
    scene.until = {"a": 1.0}
    watch.look(9000.0)
    assert len(scene.recorded) == 1


def test_an_audit_only_section_is_forgotten_like_a_monitor(scene: Scene) -> None:
    scene.audit_only = {"publish", "subscribe"}
    watch = scene.watch(None)
    watch.look(1e9)
    (row,) = [row for row in watch.rows() if row.name == "Publishers"] or watch.rows()[:1]
    assert (row.about, row.forgotten, scene.recorded) == ("policy", False, [])
    watch = scene.watch(3600.0)
    watch.look(3600.0)
    assert scene.recorded
