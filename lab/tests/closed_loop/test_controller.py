"""The controller of the worlds, against values that follow from the source of joint_trajectory_controller."""

import math

import pytest

from lab.closed_loop.controller import Controller, Point, segment


def moving(*, partial: bool = True, stopping: float = 0.0) -> Controller:
    """Return the controller of two joints, of which both drive from 0 to 10 rad, from 0 to 10 s."""
    arm = Controller(("a", "b"), period=0.001, partial=partial, stopping=stopping, begin=-1.0)
    assert arm.take(-0.001, ("b", "a"), 0.0, [Point(10.0, (10.0, 10.0))])
    return arm


@pytest.mark.parametrize(
    ("stamp", "points", "at", "place"),
    [
        (None, [Point(1.0, (3.0,))], 2.501, 2.5),  # from 2 rad at 2 s
        (None, [Point(0.0, (9.0,)), Point(1.0, (3.0,))], 2.501, 2.5),  # the first point is over
        (1.0, [Point(0.5, (9.0,)), Point(2.0, (4.0,))], 2.5, 3.0),  # one is over, and the other in a second
        (1.0, [Point(0.5, (9.0,)), Point(1.0, (9.0,))], 2.5, 2.5),  # none is left: the old one goes on
        (3.0, [Point(1.0, (9.0,))], 2.9, 2.9),  # it has not begun
        (3.0, [Point(1.0, (9.0,))], 3.5, 6.0),
        (3.0, [Point(0.0, (9.0,)), Point(1.0, (9.0,))], 3.001, 9.0),  # it jumps
        (None, [Point(1.0, (3.0,), (0.0,))], 2.501, 2.625),  # a cubic from 1 rad/s
        (None, [Point(1.0, (3.0,), (0.0,), (0.0,))], 2.501, 2.65625),  # a quintic
        (None, [Point(1.0, (3.0,), (), (9.0,))], 2.501, 2.5),  # no velocity: straight
        (None, [Point(2.0, (3.0,)), Point(1.0, (9.0,))], 2.5, 2.5),  # rejected
        (None, [Point(1.0, (3.0,), (1.0, 2.0))], 2.5, 2.5),
        (3.0, [Point(-0.5, (3.0,)), Point(1.0, (9.0,))], 3.5, 3.5),
    ],
)
def test_a_trajectory_takes_over_where_the_old_one_is(
    stamp: float | None, points: list[Point], at: float, place: float
) -> None:
    arm = moving()
    arm.take(2.0, ("a",), stamp, points)
    assert arm.state(0, at)[0] == pytest.approx(place, abs=2e-3)
    assert arm.state(1, at)[0] == pytest.approx(at), "a joint that is left out goes on"


@pytest.mark.parametrize(
    ("partial", "names", "taken"),
    [
        (True, ("b",), True), (False, ("b",), False), (False, ("b", "a"), True),
        (True, ("b", "c"), False), (True, (), False),
    ],
)  # fmt: skip
def test_a_trajectory_of_other_joints_is_rejected(partial: bool, names: tuple[str, ...], taken: bool) -> None:
    assert moving(partial=partial).take(2.0, names, None, [Point(1.0, (0.0,) * len(names))]) is taken


@pytest.mark.parametrize(("every", "way"), [(math.inf, 0.3125), (0.1, 1.735), (0.02, 5.282)])
def test_a_stop_takes_its_time_and_one_that_is_repeated_begins_again(every: float, way: float) -> None:
    """A stop has five eighths of velocity x duration; each further one begins at the velocity that is left."""
    arm = moving(stopping=0.5)
    for number in range(1 if every == math.inf else round(8 / every)):
        arm.take(2.0 + number * (every if number else 0), ("a", "b"), None, ())
    assert arm.state(0, 100)[0] == pytest.approx(2 + way, abs=5e-3)
    assert moving().state(0, 2.0)[1] == 1


def test_a_segment_has_the_values_of_both_ends() -> None:
    one, other = (1.0, 2.0, 3.0), (4.0, -5.0, 6.0)
    found = segment(7.0, one, 7.5, other)
    assert found.state(7.0) == pytest.approx(one) and found.state(7.5) == pytest.approx(other)
    assert found.state(8.0) == pytest.approx((4.0, 0.0, 0.0)) and found.state(6.0) == (1.0, 0.0, 0.0)
