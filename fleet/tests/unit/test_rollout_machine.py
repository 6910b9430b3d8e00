from collections.abc import Mapping

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosrv_fleet.rollouts.machine import (
    BundleRollout,
    HealthGates,
    RobotSeen,
    RolloutState,
    advance,
    counts,
    fault_of_rings,
    resume,
    revert,
    ring_of,
    stop,
    target,
)
from rosrv_fleet.rollouts.service import conditions

from appliance.formats.terms import Ring, Terms

OLD, KEPT, NEW = "s/g/1.tar", "s/g/2.tar", "s/g/3.tar"
RINGS = [Ring("canary", ["r0", "r1"], 0, 0), Ring("some", [], 40, 100), Ring("rest", [], 100, 100)]
GATES = HealthGates(healthy_seconds=50, ring_seconds=1000, silent_seconds=120)
ROBOTS = [f"r{number}" for number in range(20)]

reports = st.builds(
    RobotSeen,
    seen=st.just(0.0),
    in_force=st.sampled_from([OLD, NEW, NEW]),
    refused=st.sampled_from(["", "", "", "", NEW]),
    denials=st.sampled_from([0, 0, 0, 5, 40]),
    failing=st.sampled_from([0, 0, 0, 0, 1]),
)
looks = st.lists(
    st.tuples(
        st.floats(0, 200),
        st.dictionaries(st.sampled_from(ROBOTS), st.tuples(reports, st.sampled_from([0.0, 0.0, 500.0]))),
    ),
    max_size=30,
)


def begun(terms: Terms | None = None, gates: HealthGates = GATES) -> BundleRollout:
    return BundleRollout(NEW, OLD, terms or Terms(0, RINGS), gates, 0.0)


def all_at(now: float, in_force: str = NEW, most: int = 20) -> dict[str, RobotSeen]:
    return {robot: RobotSeen(now, in_force) for robot in ROBOTS[:most]}


@given(looks)
def test_the_invariants_hold_for_all_reports(
    steps: list[tuple[float, Mapping[str, tuple[RobotSeen, float]]]],
) -> None:
    rollout, now = begun(), 0.0
    robots = {robot: RobotSeen(0.0, OLD) for robot in ROBOTS}
    for passed, news in steps:
        now += passed
        for robot, (seen, ago) in news.items():
            robots[robot] = RobotSeen(
                now - ago, seen.in_force, "", seen.refused, "", False, seen.denials, seen.failing
            )
        before, rollout = rollout, advance(rollout, robots, now)
        assert rollout.ring - before.ring in (0, 1)
        if rollout.ring > before.ring:
            assert now >= rollout.terms.rings[rollout.ring].after
            opens = [seen.seen for robot, seen in robots.items() if ring_of(rollout, robot) == rollout.ring]
            assert not any(opens) or now - max(opens) <= GATES.silent_seconds
            if before.ring >= 0:
                assert before.healthy is not None
                assert now - before.healthy >= GATES.healthy_seconds
        if before.state != "running":
            assert rollout == before
        if rollout.state == "done":
            assert rollout.ring == len(RINGS) - 1
        for robot, seen in robots.items():
            choice = target(rollout, robot, seen)
            assert choice in (OLD, NEW)
            if choice == NEW and rollout.state != "done":
                assert ring_of(rollout, robot) <= rollout.ring
            if rollout.state == "stopped":
                assert choice == OLD or seen.in_force == NEW
        assert sum(row["robots"] for row in counts(rollout, robots, now)) == len(ROBOTS)  # type: ignore[misc]  # the values of a row are objects


def test_healthy_robots_finish_a_rollout() -> None:
    rollout, now = begun(), 0.0
    while rollout.state == "running" and now < 10_000:
        robots = {robot: RobotSeen(now, target(rollout, robot, None)) for robot in ROBOTS}
        rollout, now = advance(rollout, robots, now), now + 10
    assert rollout.state == "done"
    assert 200 <= now <= 400


@pytest.mark.parametrize(
    ("sick", "word"),
    [
        (RobotSeen(60, OLD, refused=NEW, reason="a test failed"), "refused: a test failed"),
        (RobotSeen(60, NEW, denials=12), "12 denials a minute, 4 before"),
        (RobotSeen(60, NEW, failing=1), "1 monitor fails, 0 before"),
        (RobotSeen(60, "", trying=NEW, denials=12), "denials"),
        (RobotSeen(-200, NEW), "silent"),
    ],
)
def test_a_bad_canary_stops(sick: RobotSeen, word: str) -> None:
    known = {robot: RobotSeen(0, OLD, denials=4) for robot in ROBOTS}
    rollout = advance(begun(), known, 0)
    assert rollout.ring == 0
    robots = all_at(60) | {"r1": sick}
    rollout = advance(rollout, robots, 60)
    assert rollout.state == "stopped"
    assert word in rollout.why
    assert target(rollout, "r0", robots["r0"]) == NEW  # in force there: it stays
    assert target(rollout, "r0", RobotSeen(60, OLD)) == OLD
    assert target(rollout, "r5", robots["r5"]) == OLD
    assert target(revert(rollout, ""), "r0", robots["r0"]) == OLD


@pytest.mark.parametrize(
    ("robot", "in_force", "expected"),
    [("r0", NEW, NEW), ("r0", KEPT, KEPT), ("r5", KEPT, KEPT), ("r5", OLD, OLD), ("r5", "", OLD)],
)
@pytest.mark.parametrize("state", ["running", "stopped"])
def test_a_robot_keeps_the_bundle_of_an_earlier_stopped_rollout_until_its_ring_opens(
    robot: str, in_force: str, expected: str, state: RolloutState
) -> None:
    rollout = msgspec.structs.replace(begun(), kept=[KEPT], ring=0, state=state)
    wanted = NEW if (robot, state) == ("r0", "running") else expected
    assert target(rollout, robot, RobotSeen(1, in_force)) == wanted
    assert target(revert(rollout, ""), robot, RobotSeen(1, in_force)) == OLD


def test_more_denials_of_the_old_bundle_do_not_stop() -> None:
    rollout = advance(begun(), all_at(0, OLD), 0)
    robots = all_at(60, OLD) | {"r0": RobotSeen(60, OLD, denials=90, failing=3)}
    assert advance(rollout, robots, 60).state == "running"


def test_robots_that_were_off_do_not_count() -> None:
    robots = all_at(0) | {"r1": RobotSeen(-5000, OLD)}
    rollout = advance(begun(), robots, 0)
    for now in (10.0, 70.0, 130.0):
        robots = all_at(now) | {"r1": RobotSeen(-5000, OLD)}
        rollout = advance(rollout, robots, now)
    assert rollout.state == "running"
    assert rollout.ring >= 1


@given(st.lists(st.sampled_from([0, 200, 900, 10_000_000]), min_size=len(ROBOTS), max_size=len(ROBOTS)))
def test_no_ring_passes_that_no_robot_was_judged_of(comes: list[int]) -> None:
    began = dict(zip(ROBOTS, comes, strict=True))
    rollout, robots = begun(), dict[str, RobotSeen]()
    for now in range(1, 3000, 20):
        robots = {
            robot: RobotSeen(now, target(rollout, robot, None)) if now >= begins else RobotSeen(-5000, OLD)
            for robot, begins in began.items()
        }
        rollout = advance(rollout, robots, now)
        if rollout.state != "running":
            break
    taken = sum(seen.in_force == NEW for seen in robots.values())
    judged = {ring_of(rollout, robot) for robot in rollout.baselines}
    first = [begins for robot, begins in began.items() if ring_of(rollout, robot) == 0]
    assert judged == set(range(rollout.ring + 1))
    if rollout.state == "done":
        assert rollout.why.startswith(f"in force on {taken} of 20 robots")
    elif rollout.state == "running":
        assert rollout.why == f"ring {RINGS[rollout.ring + 1].name} has no robot that reports"
    else:
        assert min(first) > GATES.ring_seconds


@pytest.mark.parametrize(("refusing", "state"), [(["r3", "r4"], "running"), (["r3", "r4", "r5"], "stopped")])
def test_refusals_of_robots_that_were_off_when_their_ring_opened_count(
    refusing: list[str], state: RolloutState
) -> None:
    gates = msgspec.structs.replace(GATES, tolerance=0.1)
    terms = Terms(0, [Ring("all", [], 100)])
    rollout = advance(
        begun(terms, gates), {robot: RobotSeen(-5000, OLD) for robot in ROBOTS} | all_at(0, OLD, 1), 0
    )
    assert list(rollout.baselines) == ["r0"]
    robots = all_at(60) | {robot: RobotSeen(60, OLD, "", NEW) for robot in refusing}
    assert advance(rollout, robots, 60).state == state
    assert advance(rollout, robots | {"r0": RobotSeen(60, NEW, failing=1)}, 60).state == "stopped"


def test_a_ring_that_is_not_taken_stops_after_its_time() -> None:
    rollout = advance(begun(), all_at(0, OLD), 0)
    assert advance(rollout, all_at(900, OLD), 900).state == "running"
    late = advance(rollout, all_at(1001, OLD), 1001)
    assert late.state == "stopped"
    assert "0 of 2 robots of ring canary" in late.why


def test_a_canary_ring_without_robots_stops_after_its_time() -> None:
    robots = {"r9": RobotSeen(0, OLD)}
    rollout = advance(begun(), robots, 0)
    assert rollout.ring == -1
    assert "ring canary has no robot that reports" in rollout.why
    assert stop(rollout, "by hand").state == "stopped"
    assert advance(rollout, robots, 1000).state == "running"
    assert advance(rollout, robots, 1001).state == "stopped"
    assert advance(resume(rollout, 5000), robots, 6000).state == "running"


@pytest.mark.parametrize(
    ("rings", "fault"),
    [
        (RINGS, ""),
        (
            [Ring("canary", ["r-zero", "r1"]), Ring("rest", [], 100)],
            "ring canary names r-zero, not enrolled in s/g",
        ),
        ([Ring("canary", ["r1"]), Ring("some", ["R2"]), Ring("rest", [], 100)], "ring some names R2"),
        ([Ring("canary", [], 1), Ring("rest", [], 100)], "the first ring, canary, has none of the 20 robots"),
    ],
    ids=["right", "beside a right name", "later", "percent"],
)
def test_rings_fit_the_enrolled_robots(rings: list[Ring], fault: str) -> None:
    found = fault_of_rings(begun(Terms(0, rings)), ROBOTS)
    assert fault in found
    assert bool(found) == bool(fault)


def test_a_removed_robot_counts_no_more() -> None:
    rollout = advance(begun(), all_at(0), 0)
    robots = all_at(10)
    del robots["r1"]
    assert advance(rollout, robots, 10).why == "healthy"
    del robots["r0"]
    late = advance(rollout, robots, 10)
    assert late.state == "stopped"
    assert "no robot of ring canary is enrolled" in late.why


def test_a_time_without_a_collector_counts_for_no_gate() -> None:
    rollout = advance(advance(begun(), all_at(0), 0), all_at(1), 1)
    assert rollout.healthy == 1
    later = resume(rollout, 5000)
    assert advance(later, all_at(5001), 5001).ring == 0
    assert advance(later, all_at(5001, OLD), 5001).state == "running"
    assert advance(rollout, all_at(5001, OLD), 5001).state == "stopped"


@pytest.mark.parametrize(
    ("seen", "kind", "why"),
    [
        (RobotSeen(), "never seen", "never reported"),
        (RobotSeen(10), "silent", "no report for 990 s"),
        (RobotSeen(1000, NEW, failing=1), "unhealthy", "1 monitor fails, 0 before"),
        (RobotSeen(1000, OLD, refused=NEW, reason="a test"), "unhealthy", "refused: a test"),
        (RobotSeen(1000, OLD, trouble="no route"), "behind", "no route"),
        (RobotSeen(1000, NEW), "in force", ""),
        (RobotSeen(1000, NEW, changed=True), "in force", "changed by an operator"),
    ],
)
def test_the_condition_is_the_worst_that_applies(seen: RobotSeen, kind: str, why: str) -> None:
    rollout = advance(begun(), all_at(0), 0)
    found = conditions(rollout, all_at(1000) | {"r0": seen}, 1000)["r0"]
    assert found.kind == kind
    assert why in found.why


def test_without_a_rollout_a_robot_is_not_behind() -> None:
    off = conditions(None, {"r2": RobotSeen(5), "r3": RobotSeen(1000)}, 1000, {"r2", "r3"})
    assert [one.kind for one in off.values()] == ["off", "no bundle"]
    found = conditions(None, {"r0": RobotSeen(1000), "r1": RobotSeen(1000, OLD), "r2": RobotSeen(5)}, 1000)
    assert [one.kind for one in found.values()] == ["no bundle", "in force", "silent"]


@pytest.mark.parametrize(
    ("seen", "kind"),
    [
        (RobotSeen(1000, OLD, refused=NEW, denials=500), "in force"),
        (RobotSeen(1000, NEW, failing=1), "behind"),
        (RobotSeen(1000, "", refused=OLD), "unhealthy"),
    ],
)
def test_after_a_revert_the_conditions_are_about_the_bundle_before(seen: RobotSeen, kind: str) -> None:
    rollout = revert(advance(begun(), all_at(0), 0), "reverted by olga")
    assert conditions(rollout, all_at(1000) | {"r0": seen}, 1000)["r0"].kind == kind
