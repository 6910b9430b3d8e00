"""Define the interface of executors, and the loop that retries jobs whose worker died.

The result is the same everywhere, because `work` depends only on the job and the recording.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from roswire.counted import counted

ATTEMPTS = 3

Work = Callable[[bytes], bytes]


@dataclass(frozen=True)
class WorkerDeath:
    """The worker of a job ended without a result."""

    reason: str


class Executor(Protocol):
    """Executes several jobs at the same time."""

    @property
    def capacity(self) -> int:
        """Return the number of jobs to submit before the first result."""

    def submit(self, number: int, job: bytes) -> None: ...

    def collect(self) -> list[tuple[int, bytes | WorkerDeath]]:
        """Wait until at least one submitted job has ended."""

    def close(self) -> None: ...


class ThisProcess:
    """Executes jobs one by one in this process."""

    capacity = 1

    def __init__(self, work: Work) -> None:
        self._work = work
        self._waiting: deque[tuple[int, bytes]] = deque()

    def submit(self, number: int, job: bytes) -> None:
        self._waiting.append((number, job))

    def collect(self) -> list[tuple[int, bytes | WorkerDeath]]:
        number, job = self._waiting.popleft()
        return [(number, self._work(job))]

    def close(self) -> None:
        """Do nothing."""


def execute(
    executor: Executor, jobs: Iterable[tuple[int, bytes]]
) -> Iterator[tuple[int, bytes | WorkerDeath]]:
    """Yield the number and the result of each job, in the order in which they end.

    A job whose worker dies is tried `ATTEMPTS` times in total. Jobs are read as they are needed.
    """
    supply = iter(jobs)
    again: deque[tuple[int, bytes]] = deque()
    running: dict[int, bytes] = {}
    attempts: dict[int, int] = {}
    while True:
        while len(running) < executor.capacity:
            number, job = again.popleft() if again else next(supply, (None, b""))
            if number is None:
                break
            running[number] = job
            attempts[number] = attempts.get(number, 0) + 1
            executor.submit(number, job)
        if not running:
            return
        for number, result in executor.collect():
            job = running.pop(number)
            if isinstance(result, WorkerDeath) and attempts[number] < ATTEMPTS:
                again.append((number, job))
                continue
            tried = attempts.pop(number)
            if isinstance(result, WorkerDeath):
                yield number, WorkerDeath(f"{result.reason}; tried {counted(tried, 'time')}")
            else:
                yield number, result
