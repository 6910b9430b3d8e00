"""Execute jobs, and return their results: from the journal if it has them, otherwise from workers."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import msgspec

from rosmop.batch.executor import Executor, ThisProcess, WorkerDeath, execute
from rosmop.batch.jobs import Failure, Job, Result, packed, unpacked, work
from rosmop.batch.journal import ResumeJournal, TemporaryStore
from rosmop.batch.process_pool import ProcessPool
from rosmop.batch.ray_cluster import RayCluster


@dataclass(frozen=True)
class JobRunner:
    """An executor, and perhaps a journal. `done` gets the number of each job that ended."""

    executor: Executor
    journal: ResumeJournal | None

    def run(
        self, jobs: Sequence[Job], done: Callable[[int], None] = lambda _number: None
    ) -> Iterator[tuple[int, Result | Failure]]:
        waiting: list[int] = []
        for number, job in enumerate(jobs):
            known = self.journal.result(packed(job)) if self.journal is not None else None
            if known is None:
                waiting.append(number)
                continue
            done(number)
            yield number, unpacked(known)
        for number, answer in execute(self.executor, ((number, packed(jobs[number])) for number in waiting)):
            if isinstance(answer, WorkerDeath):
                done(number)
                yield number, Failure(answer.reason)
                continue
            try:
                result = unpacked(answer)
            except ValueError as error:
                result = Failure(f"its worker answered something else: {error}")
            if self.journal is not None and not isinstance(result, Failure):
                self.journal.add(packed(jobs[number]), answer)
            done(number)
            yield number, result

    def in_order(
        self, jobs: Sequence[Job], done: Callable[[int], None] = lambda _number: None
    ) -> Iterator[Result | Failure]:
        following = 0
        places: dict[int, tuple[int, int]] = {}
        with TemporaryStore() as early:
            for number, result in self.run(jobs, done):
                if number != following:
                    places[number] = early.append(msgspec.msgpack.encode(result))
                    continue
                yield result
                following += 1
                while following in places:
                    yield unpacked(early.read(places.pop(following)))
                    following += 1


@contextmanager
def executor_for(recordings: int, workers: int | None, cluster: str | None) -> Iterator[Executor]:
    executor: Executor
    count = min(workers or len(os.sched_getaffinity(0)), recordings)
    if cluster is not None:
        executor = RayCluster(work, cluster)
    else:
        executor = ProcessPool(work, count) if count > 1 else ThisProcess(work)
    try:
        yield executor
    finally:
        executor.close()
