"""Tests of removing old records: only what may go, never silently, and provable afterwards."""

import itertools
import sqlite3
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.findings import Kind
from appliance.audit.query import Filter
from appliance.audit.retention import Retention
from appliance.audit.search import export, search
from appliance.audit.verify import verify
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog

_DAY = 86_400_000_000_000
_LIMIT_SECONDS = 30


def await_removal(path: Path, through: int = 1) -> None:
    """Wait until retention removed the records up to a sequence."""
    tick, end = threading.Event(), time.monotonic() + _LIMIT_SECONDS
    while next(export(path, Filter(), page=1)).sequence <= through:
        assert time.monotonic() < end
        tick.wait(0.02)


def make_old(make_log: MakeLog, path: Path) -> None:
    """A log of 2000 records that are a week old."""
    clock = itertools.count(time.time_ns() - 7 * _DAY, 1000)
    log = make_log(checkpoint_every=100, clock=lambda: next(clock))
    for number in range(2000):
        log.record(decision(log, number, time=next(clock), reason=f"old {number}"))
        if number % 100 == 99:
            settle(log)
    log.record(decision(log, time=next(clock)))
    log.close()


def test_old_records_go_and_that_is_recorded(make_log: MakeLog, path: Path) -> None:
    """Records past the limit are removed, the log says which, and verification proves the rest."""
    make_old(make_log, path)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    fresh = decision(log, reason="fresh")
    log.record(fresh)
    await_removal(path, 1900)
    settle(log)
    log.close()
    reports = [entry.record for entry in export(path, Filter(event="records removed"))]
    removed = sum(one.detail["count"] for one in reports)
    kept = list(export(path, Filter()))
    assert removed >= 1900
    assert kept[0].sequence == removed + 1
    assert "older than 1" in reports[0].reason
    assert kept[-1].sequence == len(kept) + removed
    assert search(path, Filter(text="fresh")).entries
    assert not search(path, Filter(text="old 17")).entries
    result = verify(path)
    assert result.ok, result.findings
    assert result.removed == removed


def test_nothing_young_goes(make_log: MakeLog, path: Path) -> None:
    """Records within the limits stay, all of them."""
    log = make_log(checkpoint_every=10, retention=Retention(days=1, size=1 << 30))
    for number in range(500):
        log.record(decision(log, number))
    settle(log)
    log.close()
    assert not search(path, Filter(event="records removed")).entries
    assert search(path, Filter()).entries[-1].sequence


def test_size(make_log: MakeLog, path: Path) -> None:
    """A log that grows past its size loses its oldest records, and stays near the limit."""
    log = make_log(checkpoint_every=200, retention=Retention(size=2 << 20))
    for number in range(12_000):
        log.record(decision(log, number))
        if number % 200 == 0:
            settle(log)
    settle(log)
    await_removal(path)
    end, tick = time.monotonic() + _LIMIT_SECONDS, threading.Event()
    while next(export(path, Filter(), page=1)).sequence < 3000:
        assert time.monotonic() < end
        log.record(decision(log))
        tick.wait(0.05)
    log.close()
    result = verify(path)
    assert result.ok, result.findings
    assert "larger than" in search(path, Filter(event="records removed")).entries[0].record.reason


def test_unsigned_records_stay(make_log: MakeLog, path: Path) -> None:
    """What the signer has not signed yet is not removed, however old it is."""
    clock = itertools.count(time.time_ns() - 7 * _DAY, 1000)
    log = make_log(checkpoint_every=100, clock=lambda: next(clock), signer=lambda number, text: None)
    for number in range(1000):
        log.record(decision(log, number, time=next(clock)))
    settle(log)
    log.close()
    log = make_log(retention=Retention(days=1), signer=lambda number, text: None)
    log.record(decision(log))
    settle(log)
    log.close()
    assert next(export(path, Filter())).sequence == 1


def test_removal_by_hand_is_not_retention(make_log: MakeLog, path: Path) -> None:
    """Removing more than retention said it removed is found."""
    make_old(make_log, path)
    log = make_log(retention=Retention(days=1))
    log.record(decision(log))
    await_removal(path)
    log.close()
    first = next(export(path, Filter())).sequence
    with closing(sqlite3.connect(path)) as attacker:
        attacker.execute("DELETE FROM record WHERE sequence <= ?", (first,))
        attacker.commit()
    assert (Kind.MISSING, first, first) in {(one.kind, one.first, one.last) for one in verify(path).findings}


@pytest.mark.parametrize("wrong", [{"days": 0}, {"days": -1}, {"size": 100}])
def test_limits_that_make_no_sense(wrong: dict[str, Any]) -> None:
    """Limits that would remove everything are refused."""
    with pytest.raises(ValueError, match="retention needs"):
        Retention(**wrong)
