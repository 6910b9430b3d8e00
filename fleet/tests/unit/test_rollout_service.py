import asyncio
import datetime
from collections.abc import Callable, Collection, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest
from rosrv_fleet.bundles.publication import PublishedBundles
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.rollouts.machine import Baseline, BundleRollout, HealthGates, OperatorAct, RobotSeen
from rosrv_fleet.rollouts.service import BundleService, RolloutRefusedError
from rosrv_fleet.rollouts.store import RolloutStore, StoredReport, StoredRollout
from tuf.api.metadata import Root

from appliance.formats.bundle_api import RobotReport
from appliance.formats.terms import BundlePath, Ring, Terms

T = TypeVar("T")
_GROUP = RobotGroup("site-a", "arms")
_PATH = "site-a/arms/2.tar"
_TAKEN = RobotReport("site-a", "arms", _PATH, "", "", "", changed=False, denials=0, failing=0, trouble="")
_ROLLOUT = BundleRollout(
    _PATH, "site-a/arms/1.tar", Terms(0, [Ring("canary", ["r-0"]), Ring("rest", [], 100)]), HealthGates(), 0.0,
    ring=0, opened=1000.0, healthy=1000.0, baselines={"r-0": Baseline(0, 0)}, why="healthy",
    acts=[OperatorAct(0.0, "olga", "start")],
)  # fmt: skip


class _Memory(RolloutStore):
    def __init__(self) -> None:
        super().__init__(IndexDatabase("", connections=1, statement_seconds=1.0))
        self.stored = StoredRollout(1, _ROLLOUT)
        self.seen = {"r-0": StoredReport(_GROUP, RobotSeen(1000.0, _PATH))}
        self.meddle: Callable[[], None] = lambda: None

    def change(self, **fields: Any) -> None:
        self.stored = StoredRollout(1, msgspec.structs.replace(self.stored.rollout, **fields))

    def latest(self) -> dict[RobotGroup, StoredRollout]:
        return {_GROUP: self.stored}

    def replace(self, _group: RobotGroup, before: StoredRollout, rollout: BundleRollout, _now: float) -> bool:
        self.meddle()
        if before != self.stored:
            return False
        self.stored = StoredRollout(1, rollout)
        return True

    def begin(
        self, _group: RobotGroup, _last: StoredRollout | None, rollout: BundleRollout, _now: float
    ) -> int | None:
        self.stored = StoredRollout(1, rollout)
        return 1

    def reports(self) -> dict[str, StoredReport]:
        return dict(self.seen)

    def save_report(self, name: str, group: RobotGroup, seen: RobotSeen) -> None:
        self.seen[name] = StoredReport(group, seen)


class _Calls:
    """Runs calls in the loop instead of in a thread. The first call of `held` waits for `go`.

    It waits before its work, or with `answered` after it.
    """

    def __init__(self, held: str = "", *, answered: bool = True) -> None:
        self.held = held
        self.answered = answered
        self.began, self.go = asyncio.Event(), asyncio.Event()

    async def __call__(self, work: Callable[..., T], *arguments: Any) -> T:
        holds = getattr(work, "__name__", "") == self.held and not self.began.is_set()
        if not holds:
            await asyncio.sleep(0)
            return work(*arguments)
        self.began.set()
        if self.answered:
            result = work(*arguments)
            await self.go.wait()
            return result
        await self.go.wait()
        return work(*arguments)

    async def during(self, tick: Coroutine[Any, Any, None], other: Coroutine[Any, Any, object]) -> None:
        ticking = asyncio.create_task(tick)
        await self.began.wait()
        beside = asyncio.create_task(other)
        for _ in range(1000):
            await asyncio.sleep(0)
        self.go.set()
        await asyncio.gather(ticking, beside)


@pytest.fixture
def store() -> _Memory:
    return _Memory()


def _service(
    store: _Memory, folder: Path, now: list[float], robots: Collection[str] = ("r-0",)
) -> BundleService:
    members = dict.fromkeys(robots, _GROUP)
    return BundleService(folder / "absent", folder / "key", store, lambda: members, lambda: now[0])


def _published(bundles: dict[str, Terms]) -> PublishedBundles:
    return PublishedBundles(Root(), 1, bundles, datetime.datetime.max)  # noqa: DTZ901  never compared


def _run(monkeypatch: pytest.MonkeyPatch, calls: _Calls, work: Coroutine[Any, Any, T]) -> T:
    monkeypatch.setattr(asyncio, "to_thread", calls)
    return asyncio.run(work)


@pytest.mark.parametrize("number", [None, 1])
def test_a_tick_refuses_no_order(
    number: int | None, store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = iter(({"why": "ring canary is open"}, {"healthy": None}, {"healthy": 1001.0}))
    store.meddle = lambda: store.change(**next(changes, {}))
    service = _service(store, tmp_path, [1010.0])
    stopped = _run(monkeypatch, _Calls(), service.stop(_GROUP, "otto", number))
    assert (stopped.rollout.state, stopped.rollout.why) == ("stopped", "stopped by otto")
    assert [act.who for act in stopped.rollout.acts] == ["olga", "otto"]
    assert store.stored == stopped


def test_another_operator_refuses_an_order(
    store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    acts = [*_ROLLOUT.acts, OperatorAct(1005.0, "olga", "stop")]
    store.meddle = lambda: store.change(state="stopped", acts=acts)
    service = _service(store, tmp_path, [1010.0])
    with pytest.raises(RolloutRefusedError, match="changed in the meantime"):
        _run(monkeypatch, _Calls(), service.stop(_GROUP, "otto"))
    assert store.stored.rollout.acts == acts


def test_a_rollout_that_always_changes_ends_an_order(
    store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = iter(range(1000))
    store.meddle = lambda: store.change(healthy=float(next(numbers)))
    service = _service(store, tmp_path, [1010.0])
    with pytest.raises(RolloutRefusedError, match="changed in the meantime"):
        _run(monkeypatch, _Calls(), service.stop(_GROUP, "otto"))
    assert next(numbers) > 3


def test_an_older_tick_undoes_no_order(
    store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, calls = _service(store, tmp_path, [1010.0]), _Calls("latest")
    _run(monkeypatch, calls, calls.during(service.tick(), service.stop(_GROUP, "otto")))
    assert service.rollouts[_GROUP].rollout.state == "stopped"


def test_a_tick_forgets_no_report(store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store.seen["r-0"] = StoredReport(_GROUP, RobotSeen(1000.0))
    service, calls = _service(store, tmp_path, [1010.0]), _Calls("reports")
    _run(monkeypatch, calls, calls.during(service.tick(), service.report("r-0", _GROUP, _TAKEN)))
    assert service.robots[_GROUP]["r-0"] == RobotSeen(1010.0, _PATH)


def test_an_absence_is_health_for_no_tick(
    store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]
    service, calls = _service(store, tmp_path, now), _Calls("replace", answered=False)

    async def run() -> None:
        await service.tick()
        now[0] += 3600.0
        await calls.during(service.tick(), service.tick())

    _run(monkeypatch, calls, run())
    assert (store.stored.rollout.ring, store.stored.rollout.healthy) == (0, 4600.0)


@pytest.mark.parametrize("restarted", [True, False])
def test_a_clock_that_was_ahead_disables_no_gate_after_its_correction(
    restarted: bool, store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot's silence stops the rollout as soon as if the clock had never been ahead."""
    now = [1000.0]

    async def run() -> None:
        service = _service(store, tmp_path, now)
        await service.tick()
        now[0] += 30 * 86_400.0
        await service.tick()
        await service.report("r-0", _GROUP, _TAKEN)
        await service.tick()
        now[0] -= 30 * 86_400.0
        if restarted:
            service = _service(store, tmp_path, now)
        for _half_minute in range(6):
            assert service.rollouts.get(_GROUP, store.stored).rollout.state == "running"
            await service.tick()
            now[0] += 30.0
        assert service.rollouts[_GROUP].rollout.why.endswith("r-0: silent for 150 s")

    _run(monkeypatch, _Calls(), run())
    assert (store.stored.rollout.state, store.stored.rollout.opened) == ("stopped", 1000.0)


def test_a_rollout_with_an_unknown_robot_does_not_start(
    store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, path = _service(store, tmp_path, [1010.0]), "site-a/arms/3.tar"
    terms = Terms(0, [Ring("canary", ["r-0", "r-zero"]), Ring("rest", [], 100)])
    service.publisher.publication = _published({path: terms})
    with pytest.raises(RolloutRefusedError, match="r-zero, not enrolled in site-a/arms"):
        _run(monkeypatch, _Calls(), service.start(BundlePath.parse(path), HealthGates(), "olga"))
    assert store.stored.rollout == _ROLLOUT


@pytest.mark.parametrize(
    ("end", "signed", "selected"),
    [("stopped", "123", 2), ("stopped", "13", 1), ("reverted", "123", 1), ("done", "123", 2)],
    ids=["stopped", "stopped and withdrawn", "reverted", "done"],
)
def test_the_next_rollout_moves_no_robot_of_a_later_ring_back(
    end: str, signed: str, selected: int, *, store: _Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fourth rollout also knows what the second one left, because the third one stopped."""
    service = _service(store, tmp_path, [1010.0], ("r-0", "r-9"))
    terms = Terms(0, [Ring("canary", ["r-0"]), Ring("rest", [], 100)])
    paths = {f"site-a/arms/{version}.tar": terms for version in f"{signed}45"}
    service.publisher.publication = _published(paths)
    store.seen["r-9"] = StoredReport(_GROUP, RobotSeen(1000.0, _PATH))
    store.change(state=end)

    async def run() -> None:
        for version in (4, 5):
            await service.start(BundlePath("site-a", "arms", version), HealthGates(), "olga")
            assert service.selection("r-9", _GROUP) == f"site-a/arms/{selected}.tar"
            await service.stop(_GROUP, "olga")
            assert service.selection("r-9", _GROUP) == f"site-a/arms/{selected}.tar"

    _run(monkeypatch, _Calls(), run())


def test_a_rollout_of_an_earlier_release_keeps_its_form() -> None:
    """The store does not change a rollout whose document has changed since it was read."""
    document = msgspec.json.encode(_ROLLOUT)
    assert b"kept" not in document
    assert msgspec.json.encode(msgspec.json.decode(document, type=BundleRollout)) == document
