"""Which topics get loops that take many messages at once, in which forms; what they do is compared in test_passage."""

import struct

import pytest

from appliance.ros.definitions import Definitions
from appliance.rosmop.batch import MAX_LAYOUTS, Walker
from appliance.rosmop.engine import MonitorSet
from tests.unit.rosmop.random_specifications import definitions

NOTHING = struct.pack("<BidfBII3qI", 0, 0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0)


def loops(
    body: str, *, event: str = "own/Plain '{count:count}'", parameters: str = "int count"
) -> MonitorSet:
    """A set with one event on `/plain`, started, its first message seen."""
    text = f"s() {{ int n = 0; event e({parameters}) /plain {event} {{ {body} }} }}"
    return begun(text, definitions())


def begun(text: str, known: Definitions) -> MonitorSet:
    """A set with its loops, started."""
    monitors = MonitorSet.load({"x.rv": text}, known)
    monitors.write_loops()
    monitors.start(0)
    monitors.process("/plain", bytearray(NOTHING), 1)
    return monitors


def walk(walker: Walker, frames: bytes, stride: int, *, loud: bool = False) -> tuple[bytes, int]:
    """The bytes afterwards, and how far the walk came."""
    buffer = bytearray(frames)
    walked = walker.walk(
        memoryview(buffer), 0, 0, [], stride, 5, walker.prepare(loud=loud, told=[False] * len(walker.events))
    )
    return bytes(buffer), walked.position


@pytest.mark.parametrize(
    ("body", "has"),
    [
        ("n = count;", True),
        ('if (count > 3) { ROS_WARN("high"); }', True),
        ("count = n; n++;", True),
        ("if (n > 2) { return; }", True),
        ('ROS_INFO("each");', False),
        ("for (int i = 0; i < 3; i++) { n++; }", False),
    ],
)
def test_what_every_message_would_leave_has_no_loop(body: str, has: bool) -> None:
    """A loop that would stop at each message is not written; one that stops at some is."""
    assert (loops(body).walker("/plain") is not None) == has


def test_loops_wait_until_a_monitor_has_begun() -> None:
    """Not before the first message, not while it is held."""
    text = "hold s() { event e() /plain own/Plain '{}' { } }"
    monitors = MonitorSet.load({"x.rv": text}, definitions())
    monitors.write_loops()
    monitors.start(0, restarted=True)
    walker = monitors.walker("/plain")
    assert walker is not None
    answers = [monitors.walks(walker, 1)]
    monitors.process("/plain", bytearray(NOTHING), 1)
    answers.append(monitors.walks(walker, 1))
    monitors.resume("s")
    monitors.process("/plain", bytearray(NOTHING), 1)
    answers.append(monitors.walks(walker, 1))
    assert answers == [False, False, True]


def test_loops_wait_while_something_is_due() -> None:
    """A tick that is due comes before the next message."""
    monitors = begun("s() { event e() /plain own/Plain '{}' { } event t() every 1ms { } }", definitions())
    walker = monitors.walker("/plain")
    assert walker is not None
    assert monitors.walks(walker, 1000)
    assert not monitors.walks(walker, 2_000_000)
    monitors.advance(2_000_000)
    assert monitors.walks(walker, 2_000_000)


def test_a_disabled_monitor_has_no_walker_on_its_topic() -> None:
    """Its messages are nobody's."""
    monitors = loops("n = count;")
    monitors.set_enabled("s", False, 5)
    assert monitors.walker("/plain") is None


@pytest.mark.parametrize("stride", [0, len(NOTHING) + 4])
def test_a_walk_stops_before_what_is_to_be_told(stride: int) -> None:
    """While changes are told in full nothing is changed; afterwards all of it."""
    walker = loops("count = 7;").walker("/plain")
    assert walker is not None
    frames = (struct.pack("<I", len(NOTHING)) + NOTHING) * 6
    assert walk(walker, frames, stride, loud=True) == (frames, 0)
    changed, position = walk(walker, frames, stride)
    assert position == len(frames)
    assert changed == (struct.pack("<IBi", len(NOTHING), 0, 7) + NOTHING[5:]) * 6


def test_lengths_without_end_do_not_grow_the_walker() -> None:
    """Ways to read frames are kept for so many lengths only."""
    walker = loops("n = count;").walker("/plain")
    assert walker is not None
    for size in range(300):
        body = NOTHING + bytes(size)
        assert walk(walker, (struct.pack("<I", len(body)) + body) * 4, len(body) + 4)[1] == 4 * (
            len(body) + 4
        )
    assert len(walker._layouts) <= MAX_LAYOUTS


def test_a_frame_that_is_too_short_is_left_to_the_engine() -> None:
    """Fields of the next frame are nobody's business."""
    walker = loops("n = count;").walker("/plain")
    assert walker is not None
    frame = struct.pack("<I", 3) + b"abc"
    for stride in (0, len(frame)):
        assert walk(walker, frame * 5, stride) == (frame * 5, 0)
