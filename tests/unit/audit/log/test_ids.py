"""Tests of the ids of records."""

import itertools

import pytest

from appliance.audit.log.ids import ID_LENGTH, IdSource


def test_ids_grow_and_have_one_length() -> None:
    """Ids of one source are unique, sort as text in order of creation, and are safe in URLs."""
    source = IdSource()
    ids = [source.next() for _ in range(10_000)]
    assert ids == sorted(set(ids))
    assert {len(one) for one in ids} == {ID_LENGTH}
    assert set("".join(ids)) <= set("0123456789abcdef")


def test_ids_grow_when_the_clock_is_set_back() -> None:
    """The clock never makes an id smaller than the last one."""
    clock = itertools.chain([2_000_000_000], itertools.repeat(1_000_000_000))
    source = IdSource(clock=lambda: next(clock))
    ids = [source.next() for _ in range(5)]
    assert ids == sorted(set(ids))


def test_ids_grow_after_a_restart_with_the_clock_set_back() -> None:
    """A source that gets the last id of the log makes only greater ones, whatever the clock says."""
    last = IdSource(clock=lambda: 5_000_000_000).next()
    assert IdSource(last, clock=lambda: 1).next()[:16] > last[:16]


def test_sources_in_the_same_nanosecond_differ() -> None:
    """Two processes with the same clock make different ids (in 65535 of 65536 cases)."""
    ids = {IdSource(clock=lambda: 7).next() for _ in range(20)}
    assert len(ids) >= 18


def test_ids_report_how_far_the_clock_was_set_back() -> None:
    """Ids report how far the clock was set back, also after a restart, until the clock has caught up."""
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
