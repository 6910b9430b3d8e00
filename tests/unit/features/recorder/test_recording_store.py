import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

import msgspec
import pytest

from appliance.base.actors import APPLIANCE, ROBOT, UNKNOWN
from appliance.base.age_clock import AgeClock
from appliance.base.clock import wall_ns
from appliance.features.recorder.recording_answers import OPERATORS, Recording, Trigger, TriggerKind
from appliance.features.recorder.recording_store import ABOUT, RecordingStore
from tests.support.aging import HISTORIES, KEPT, ages_of

MIB = 1 << 20
SECOND = 1_000_000_000


def recording(
    number: int, what: TriggerKind = "drop", size: int = MIB, charged_to: str = OPERATORS
) -> Recording:
    time = number * SECOND
    trigger = Trigger(time, what, "record", "")
    return Recording(
        f"{number:020x}", time, time, [trigger], [], 1, 1,
        size=size, sha256="", complete=True, why_not="", charged_to=charged_to,
    )  # fmt: skip


def put(store: RecordingStore, kept: Recording) -> Recording:
    part = store.part(kept.id)
    part.mkdir()
    (part / ABOUT).write_bytes(msgspec.json.encode(kept))
    store.keep(kept)
    return kept


def cleared(store: RecordingStore, now: int = 0, *, room: bool = False) -> list[tuple[Recording, str]]:
    gone = []
    for kept, why in store.outdated(now):
        store.remove(kept, "", why)
        gone.append((kept, why))
    return gone + (room_for(store, OPERATORS)[0] if room else [])


def room_for(
    store: RecordingStore, charged_to: str, making: Sequence[str] = ()
) -> tuple[list[tuple[Recording, str]], str]:
    gone: list[tuple[Recording, str]] = []
    while True:
        kept, why = store.in_the_way(charged_to, making)
        if kept is None:
            return gone, why
        store.remove(kept, "", why)
        gone.append((kept, why))


def test_saved_recordings_are_found_again(tmp_path: Path) -> None:
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    second, first = put(store, recording(2)), put(store, recording(1))
    store.part("f" * 20).mkdir()
    about = (tmp_path / first.id / ABOUT).read_bytes()
    for letter, damaged in (("d", about.replace(first.id.encode(), b"\xff" * 20)), ("e", b"{")):
        assert damaged != about
        spoilt = tmp_path / (letter * 20)
        spoilt.mkdir()
        (spoilt / ABOUT).write_bytes(damaged)
    again = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    assert again.recordings == [first, second]
    assert again.parts() == [again.part("f" * 20)]
    again.remove(first, "eve", "")
    assert not (tmp_path / first.id).exists()
    assert again.find(first.id) is None
    again = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    assert list(again.removals()) == [(first, "eve", "")]
    again.note(first.id)
    assert not list(again.removals())
    assert {path.name for path in tmp_path.iterdir()} == {second.id, f".{'f' * 20}.part", "d" * 20, "e" * 20}


def test_a_noted_recording_is_reported_once(tmp_path: Path) -> None:
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    first, second = put(store, recording(1)), put(store, recording(2))
    store.note(first.id)
    store.note("0" * 20)
    assert RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns).unnoted() == [
        second
    ]


def test_the_kind_with_most_bytes_makes_room(tmp_path: Path) -> None:
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    put(store, recording(1, "order", 8 * MIB))
    put(store, recording(2, "fault", 8 * MIB))
    for number in range(3, 8):
        put(store, recording(number, "drop", 8 * MIB))
    assert not cleared(store)
    assert not cleared(store, room=True)
    put(store, recording(8, "drop", 8 * MIB))
    assert cleared(store, room=True) == [(recording(3, "drop", 8 * MIB), "recorder.disk is full")]


def test_a_guest_makes_room_from_its_own_recordings(tmp_path: Path) -> None:
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    put(store, recording(1, size=8 * MIB, charged_to=ROBOT))
    put(store, recording(2, size=8 * MIB, charged_to="10.0.0.7"))
    for number in range(3, 50):
        gone, why_not = room_for(store, "10.0.0.9")
        assert why_not == ""
        assert {found.charged_to for found, _why in gone} <= {"10.0.0.9"}
        put(store, recording(number, size=8 * MIB, charged_to="10.0.0.9"))
    held = [found.charged_to for found in store.recordings]
    assert (held.count("10.0.0.9"), held[:2]) == (2, [ROBOT, "10.0.0.7"])


@pytest.mark.parametrize(("size", "limit"), [(8 * MIB, 500), (1, 8)], ids=["bytes", "number"])
def test_no_guest_displaces_a_recording_of_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int, limit: int
) -> None:
    monkeypatch.setattr("appliance.features.recorder.recording_store.MAX_KEPT", limit)
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)

    def arrive(number: int, charged_to: str) -> str:
        _gone, why_not = room_for(store, charged_to)
        if not why_not:
            put(store, recording(number, size=size, charged_to=charged_to))
        return why_not

    for number in range(30):
        assert arrive(number, f"10.0.0.{number % 10}") == ""
    assert len(store.recordings) == 6, "three quarters"
    for number in range(30, 50):
        assert arrive(number, ROBOT) == ""
    held = [found.charged_to for found in store.recordings]
    assert held.count(ROBOT) == 4
    for number in range(50, 60):
        assert arrive(number, f"10.0.0.{number % 10}") == ""
    assert [found.charged_to for found in store.recordings].count(ROBOT) == 4


def test_a_guest_has_no_recording_if_the_robot_uses_all(tmp_path: Path) -> None:
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    for number in range(8):
        put(store, recording(number, size=8 * MIB, charged_to=ROBOT))
    assert room_for(store, "10.0.0.9") == ([], "recorder.disk is full")


@pytest.mark.parametrize("seed", range(6))
def test_a_refused_recording_removes_nothing(tmp_path: Path, seed: int) -> None:
    """Any owners in any order: hosts displace only hosts, and the robot, operators and the appliance get room."""
    disk, chance = 64 * MIB, Random(seed)  # noqa: S311  a history by seed
    ours, hosts = (ROBOT, OPERATORS, APPLIANCE), ("10.0.0.7", "10.0.0.9", UNKNOWN)
    store = RecordingStore(tmp_path, disk=disk, reserve=0, seconds=None, clock=wall_ns)
    refused: Counter[str] = Counter()
    for number in range(150):
        charged_to = chance.choice((*ours[: 1 + seed % 3], *hosts[: seed % 4], ROBOT, APPLIANCE))
        making = chance.sample(hosts, chance.randrange(3))
        gone, why_not = room_for(store, charged_to, making)
        displaced = {kept.charged_to for kept, _why in gone}
        if why_not:
            refused[charged_to] += 1
            assert not gone, (charged_to, why_not)
            continue
        assert charged_to in ours or displaced <= set(hosts)
        size = chance.choice((1, 3, 8)) * MIB
        put(store, recording(number, chance.choice(("stop", "drop")), size, charged_to))
        held: Counter[str] = Counter()
        for kept in store.recordings:
            held[kept.charged_to] += kept.size
        assert sum(held.values()) + len(making) * store.largest <= disk
        assert all(held[name] <= disk // 4 for name in (*hosts, APPLIANCE))
    assert not refused.keys() & set(ours)
    assert seed % 4 == 0 or refused


def test_descriptions_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Control receives all recordings in one message."""
    monkeypatch.setattr("appliance.features.recorder.recording_store._MAX_DESCRIBED", 1000)
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    for number in range(1, 9):
        put(store, recording(number))
    cleared(store, room=True)
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=None, clock=wall_ns)
    left = [(tmp_path / found.id / "recording.json").stat().st_size for found in store.recordings]
    assert 0 < sum(left) <= 1000


def test_old_recordings_are_removed(tmp_path: Path) -> None:
    age = 1000 * SECOND

    def make() -> RecordingStore:
        return RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=10, clock=lambda: age)

    store = make()
    put(store, recording(1))
    age += SECOND
    put(store, recording(2))
    age += 9 * SECOND - 1
    assert not cleared(make(), 5000 * SECOND)  # whatever the machine's clock says
    age += 1
    assert cleared(make()) == [(recording(1), "it is older than recorder.days")]


@pytest.mark.parametrize("by_hand", [shutil.rmtree, lambda folder: (folder / ABOUT).unlink()])
@pytest.mark.parametrize("way", ["age", "room", "order"])
def test_a_recording_that_a_person_removed_stops_no_removal(
    tmp_path: Path, way: str, by_hand: Callable[[Path], None]
) -> None:
    """Its removal is reported as that of the others, also by the next recorder."""
    age = 0

    def make() -> RecordingStore:
        return RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=10, clock=lambda: age)

    store = make()
    kept = [put(store, recording(number, size=8 * MIB)) for number in range(1, 9)]
    store.note(kept[0].id)
    for one in (kept[0], kept[2]):
        by_hand(tmp_path / one.id)
    if way == "age":
        age = 11 * SECOND
        assert [one for one, _why in cleared(store)] == kept
    elif way == "room":
        gone = [one for _recording in range(8) for one, _why in displaced(store)]
        assert gone == kept
    else:
        for one in kept:
            store.remove(one, "eve", "")
    assert store.recordings == []
    assert [one for one, _who, _why in make().removals()] == kept


def displaced(store: RecordingStore) -> list[tuple[Recording, str]]:
    """Make room, for as many recordings in progress as there are removed ones."""
    gone, why_not = room_for(store, ROBOT, [ROBOT] * (7 - len(store.recordings) + 1))
    assert not why_not
    return gone


def test_a_recording_of_an_earlier_version_ages_from_the_first_start(tmp_path: Path) -> None:
    """Its own end is by the machine's clock, which may be years behind, as for one that was made on a full disk."""
    age = 0
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=10, clock=lambda: age)
    (tmp_path / put(store, recording(1)).id / "since").unlink()
    (tmp_path / put(store, recording(2)).id / "since").write_bytes(b"")
    age = 10_000 * SECOND
    RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=10, clock=lambda: age)
    store = RecordingStore(tmp_path, disk=64 * MIB, reserve=0, seconds=10, clock=lambda: age)
    for age, gone in ((10_010 * SECOND - 1, 0), (10_010 * SECOND, 2)):  # noqa: B007  the clock reads it
        assert len(cleared(store)) == gone


class KeptRecording:
    def __init__(self, folder: Path, age: AgeClock) -> None:
        self._store = RecordingStore(
            folder, disk=64 * MIB, reserve=0, seconds=KEPT / SECOND, clock=age, dated=age.true_date
        )

    def make(self) -> None:
        put(self._store, recording(1))

    def is_due(self) -> bool:
        return next(self._store.outdated(0), None) is not None


@pytest.mark.parametrize("history", HISTORIES)
def test_recordings_are_kept_for_their_time_whatever_the_clock_does(tmp_path: Path, history: str) -> None:
    assert ages_of(tmp_path, KeptRecording, history) == []
