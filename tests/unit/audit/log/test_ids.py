import itertools

import pytest

from appliance.audit.log.ids import ID_LENGTH, IdSource


def test_ids_grow_and_have_one_length() -> None:
    source = IdSource()
    ids = [source.next() for _ in range(10_000)]
    assert ids == sorted(set(ids))
    assert {len(one) for one in ids} == {ID_LENGTH}
    assert set("".join(ids)) <= set("0123456789abcdef")


def test_ids_grow_when_the_clock_is_set_back() -> None:
    clock = itertools.chain([2_000_000_000], itertools.repeat(1_000_000_000))
    source = IdSource(clock=lambda: next(clock))
    ids = [source.next() for _ in range(5)]
    assert ids == sorted(set(ids))


def test_ids_grow_after_a_restart_with_the_clock_set_back() -> None:
    last = IdSource(clock=lambda: 5_000_000_000).next()
    assert IdSource(last, clock=lambda: 1).next()[:16] > last[:16]


def test_sources_in_the_same_nanosecond_differ() -> None:
    ids = {IdSource(clock=lambda: 7).next() for _ in range(20)}
    assert len(ids) >= 18


def test_ids_report_how_far_the_clock_was_set_back() -> None:
    now = 10_000_000_000
    before = IdSource(clock=lambda: now)
    last = before.next()
    assert before.ahead == 0.0
    now -= 4_000_000_000
    assert before.ahead == pytest.approx(4.0)
    after = IdSource(clock=lambda: now)
    after.raise_floor(last)
    assert after.ahead == pytest.approx(4.0)
    now += 5_000_000_000
    assert after.ahead == 0.0
