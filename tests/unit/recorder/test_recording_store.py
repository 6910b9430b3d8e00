"""The shelf: whole recordings only, room for the next, and those that have most of it make it."""

import time
from pathlib import Path

import msgspec
import pytest

from appliance.channel.answers.recording_answers import OPERATORS, ROBOT, Recording, Trigger, TriggerKind
from appliance.recorder.recording_store import ABOUT, Shelf

MIB = 1 << 20
SECOND = 1_000_000_000


def recording(
    number: int, what: TriggerKind = "drop", size: int = MIB, charged_to: str = OPERATORS
) -> Recording:
    """The recording of this second."""
    time = number * SECOND
    trigger = Trigger(time, what, "record", "")
    return Recording(
        f"{number:020x}",
        time,
        time,
        [trigger],
        [],
        1,
        1,
        size=size,
        sha256="",
        complete=True,
        why_not="",
        charged_to=charged_to,
    )


def put(shelf: Shelf, kept: Recording) -> Recording:
    """Keep it, as the recorder does."""
    part = shelf.part(kept.id)
    part.mkdir()
    (part / ABOUT).write_bytes(msgspec.json.encode(kept))
    shelf.keep(kept)
    return kept


def cleared(shelf: Shelf, now: int = 0, *, room: bool = False) -> list[tuple[Recording, str]]:
    """What goes, as the recorder lets it go."""
    gone = []
    for kept, why in shelf.outdated(now):
        shelf.remove(kept, "", why)
        gone.append((kept, why))
    return gone + (room_for(shelf, OPERATORS)[0] if room else [])


def room_for(shelf: Shelf, charged_to: str) -> tuple[list[tuple[Recording, str]], str]:
    """What goes for a recording of this host, and why there is no room all the same."""
    gone: list[tuple[Recording, str]] = []
    while True:
        kept, why = shelf.in_the_way(charged_to)
        if kept is None:
            return gone, why
        shelf.remove(kept, "", why)
        gone.append((kept, why))


def test_what_is_kept_is_found_again(tmp_path: Path) -> None:
    """By the next recorder, in the order of time; what had only been begun is a part, what is spoilt is none."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    second, first = put(shelf, recording(2)), put(shelf, recording(1))
    shelf.part("f" * 20).mkdir()
    spoilt = tmp_path / ("e" * 20)
    spoilt.mkdir()
    (spoilt / ABOUT).write_text("{")
    again = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    assert again.recordings == [first, second]
    assert again.parts() == [again.part("f" * 20)]
    again.remove(first, "eve", "")
    assert not (tmp_path / first.id).exists()
    assert again.find(first.id) is None
    again = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    assert list(again.removed()) == [(first, "eve", "")]
    again.note(first.id)
    assert not list(again.removed())
    assert {path.name for path in tmp_path.iterdir()} == {second.id, f".{'f' * 20}.part", "e" * 20}


def test_what_the_log_has_is_told_once(tmp_path: Path) -> None:
    """Until it is noted a recording is told again."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    first, second = put(shelf, recording(1)), put(shelf, recording(2))
    shelf.note(first.id)
    shelf.note("0" * 20)
    assert Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns).unnoted() == [second]


def test_who_has_most_makes_room(tmp_path: Path) -> None:
    """The oldest of the kind that has most bytes goes, so that a flood of drops takes away no other recording."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    put(shelf, recording(1, "order", 8 * MIB))
    put(shelf, recording(2, "fault", 8 * MIB))
    for number in range(3, 8):
        put(shelf, recording(number, "drop", 8 * MIB))
    assert not cleared(shelf)
    assert not cleared(shelf, room=True)
    put(shelf, recording(8, "drop", 8 * MIB))
    assert cleared(shelf, room=True) == [(recording(3, "drop", 8 * MIB), "recorder.disk is used up")]


def test_a_guest_makes_room_from_its_own(tmp_path: Path) -> None:
    """However many recordings a guest causes, it has a quarter of the disk, and those of other hosts stay."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    put(shelf, recording(1, size=8 * MIB, charged_to=ROBOT))
    put(shelf, recording(2, size=8 * MIB, charged_to="10.0.0.7"))
    for number in range(3, 50):
        gone, why_not = room_for(shelf, "10.0.0.9")
        assert why_not == ""
        assert {found.charged_to for found, _why in gone} <= {"10.0.0.9"}
        put(shelf, recording(number, size=8 * MIB, charged_to="10.0.0.9"))
    held = [found.charged_to for found in shelf.recordings]
    assert (held.count("10.0.0.9"), held[:2]) == (2, [ROBOT, "10.0.0.7"])


def test_no_guest_displaces_a_recording_of_the_robot(tmp_path: Path) -> None:
    """Ten guests take what is free and then from each other; the robot gets half of the disk back from them."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)

    def arrive(number: int, charged_to: str) -> str:
        _gone, why_not = room_for(shelf, charged_to)
        if not why_not:
            put(shelf, recording(number, size=8 * MIB, charged_to=charged_to))
        return why_not

    for number in range(30):
        assert arrive(number, f"10.0.0.{number % 10}") == ""
    assert len(shelf.recordings) == 6, "three quarters"
    for number in range(30, 50):
        assert arrive(number, ROBOT) == ""
    held = [found.charged_to for found in shelf.recordings]
    assert held.count(ROBOT) == 4
    for number in range(50, 60):
        assert arrive(number, f"10.0.0.{number % 10}") == ""
    assert [found.charged_to for found in shelf.recordings].count(ROBOT) == 4


def test_where_the_robot_has_all_a_guest_has_no_recording(tmp_path: Path) -> None:
    """And it is said why."""
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    for number in range(8):
        put(shelf, recording(number, size=8 * MIB, charged_to=ROBOT))
    assert room_for(shelf, "10.0.0.9") == ([], "recorder.disk is used up")


def test_descriptions_have_room_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Control is told of all recordings in one message, however many topics they have."""
    monkeypatch.setattr("appliance.recorder.recording_store._MOST_DESCRIBED", 1000)
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    for number in range(1, 9):
        put(shelf, recording(number))
    cleared(shelf, room=True)
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=None, clock=time.time_ns)
    left = [(tmp_path / found.id / "recording.json").stat().st_size for found in shelf.recordings]
    assert 0 < sum(left) <= 1000


def test_what_is_too_old_goes(tmp_path: Path) -> None:
    """After as many seconds as are configured, counted from when it was kept, by the clock of ages."""
    age = 1000 * SECOND

    def make() -> Shelf:
        return Shelf(tmp_path, disk=64 * MIB, seconds=10, clock=lambda: age)

    shelf = make()
    put(shelf, recording(1))
    age += SECOND
    put(shelf, recording(2))
    age += 9 * SECOND - 1
    assert not cleared(make(), 5000 * SECOND)  # whatever the machine's clock says
    age += 1
    assert cleared(make()) == [(recording(1), "it is older than recorder.days")]


def test_the_age_of_a_recording_of_an_earlier_version_is_that_of_its_end(tmp_path: Path) -> None:
    """It has no file that says when it was kept; an empty one, after a power cut, says nothing either."""
    age = 0
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=10, clock=lambda: age)
    (tmp_path / put(shelf, recording(1)).id / "since").unlink()
    (tmp_path / put(shelf, recording(2)).id / "since").write_bytes(b"")
    shelf = Shelf(tmp_path, disk=64 * MIB, seconds=10, clock=lambda: age)
    for age, gone in ((11 * SECOND - 1, 0), (11 * SECOND, 1), (12 * SECOND, 1)):  # noqa: B007  the clock reads it
        assert len(cleared(shelf)) == gone
