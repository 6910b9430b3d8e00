import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosmop.batch.executor import ATTEMPTS, ThisProcess, WorkerDeath, execute
from rosmop.batch.runner import ProcessPool
from rosmop.tests.batch.works import double, fragile

JOBS = [(number, bytes([number]) * (number * 40_000)) for number in range(12)]


@pytest.mark.nightly
def test_a_pool_gives_the_results_of_this_process() -> None:
    pool = ProcessPool(double, 2)
    try:
        assert dict(execute(pool, iter(JOBS))) == dict(execute(ThisProcess(double), JOBS))
        assert dict(execute(pool, iter(JOBS))) == {number: job * 2 for number, job in JOBS}, "it is reused"
    finally:
        pool.close()


@pytest.mark.nightly
def test_a_worker_that_dies_is_tried_again(tmp_path: Path) -> None:
    pool = ProcessPool(fragile, 2)
    jobs = [
        (number, f"{how} {tmp_path / str(number)}".encode())
        for number, how in enumerate(["never", "once", "always"] * 2)
    ]
    try:
        results = dict(execute(pool, jobs))
    finally:
        pool.close()
    assert [results[number] for number in (0, 1, 3, 4)] == [b"never", b"once", b"never", b"once"]
    for number in (2, 5):
        death = results[number]
        assert isinstance(death, WorkerDeath)
        assert "SIGKILL" in death.reason
        assert f"tried {ATTEMPTS} times" in death.reason
        assert len((tmp_path / str(number)).read_text().splitlines()) == ATTEMPTS
    assert [len((tmp_path / str(number)).read_text().splitlines()) for number in (0, 3)] == [1, 1], (
        "not charged"
    )


@pytest.mark.nightly
def test_a_worker_that_dies_while_idle_is_replaced(tmp_path: Path) -> None:
    pool = ProcessPool(fragile, 1)
    try:
        assert dict(execute(pool, [(0, f"never {tmp_path / 'a'}".encode())])) == {0: b"never"}
        pid = int((tmp_path / "a").read_text())
        os.kill(pid, 9)
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        assert dict(execute(pool, [(1, f"never {tmp_path / 'a'}".encode())])) == {1: b"never"}
        assert int((tmp_path / "a").read_text().splitlines()[1]) != pid
    finally:
        pool.close()


def test_jobs_are_read_as_they_are_needed() -> None:
    taken: list[int] = []

    def jobs() -> Iterator[tuple[int, bytes]]:
        for number in range(100):
            taken.append(number)
            yield number, b"x"

    results = execute(ThisProcess(double), jobs())
    next(results)
    assert len(taken) <= 2
