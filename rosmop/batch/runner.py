"""Execute jobs, and return their results: from the journal if it has them, otherwise from workers."""

import ctypes
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

import msgspec

from rosmop.batch.executor import Executor, ThisProcess, Work, WorkerDeath, execute
from rosmop.batch.jobs import Failure, Job, Result, to_bytes, unpack, work
from rosmop.batch.journal import ResumeJournal, TemporaryStore
from rosmop.batch.ray_cluster import RayCluster

# Execute jobs in processes of this machine. A process that dies takes only its own job with it.
#
# `concurrent.futures` gives up all jobs then. Here each process has its own pipe, for bytes, so nothing is unpickled.

_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl


class ProcessPool:
    """Starts its processes as they are needed."""

    def __init__(self, work: Work, capacity: int) -> None:
        self.capacity = capacity
        self._work = work
        self._context = get_context("spawn")
        self._idle: list[tuple[BaseProcess, Connection]] = []
        self._running: dict[Connection, tuple[BaseProcess, int]] = {}

    def submit(self, number: int, job: bytes) -> None:
        while True:
            is_new = not self._idle
            process, pipe = self._start() if is_new else self._idle.pop()
            try:
                pipe.send_bytes(job)
            except OSError:
                if not is_new:  # it died while it was idle
                    _end(process, pipe)
                    continue
            # A new process that died is noticed by `collect`.
            self._running[pipe] = process, number
            return

    def collect(self) -> list[tuple[int, bytes | WorkerDeath]]:
        results: list[tuple[int, bytes | WorkerDeath]] = []
        for pipe in wait(list(self._running)):
            assert isinstance(pipe, Connection)  # noqa: S101  for mypy: no others are waited for
            process, number = self._running.pop(pipe)
            try:
                result = pipe.recv_bytes()
            except (EOFError, OSError):
                process.join()
                results.append((number, WorkerDeath(_reason(process.exitcode))))
                pipe.close()
            else:
                results.append((number, result))
                self._idle.append((process, pipe))
        return results

    def close(self) -> None:
        for process, pipe in [
            *self._idle, *((process, pipe) for pipe, (process, _number) in self._running.items())
        ]:  # fmt: skip
            _end(process, pipe)
        self._idle, self._running = [], {}

    def _start(self) -> tuple[BaseProcess, Connection]:
        near, far = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(self._work, far, os.getpid()), daemon=True)
        resource_tracker.ensure_running()  # its start, with the first process, would unblock SIGINT
        # The process inherits the mask: Ctrl-C ends the parent only, which ends its processes.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        far.close()
        return process, near


def _end(process: BaseProcess, pipe: Connection) -> None:
    process.kill()
    process.join()
    pipe.close()


def _reason(status: int | None) -> str:
    if status is not None and status < 0:
        name = signal.Signals(-status).name
        hint = " (out of memory?)" if -status == signal.SIGKILL else ""
        return f"its worker was ended by {name}{hint}"
    return f"its worker ended with status {status}"


def _serve(work: Work, pipe: Connection, parent: int) -> None:
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        return
    while True:
        try:
            job = pipe.recv_bytes()
        except EOFError:
            return
        pipe.send_bytes(work(job))


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
            known = self.journal.result(to_bytes(job)) if self.journal is not None else None
            if known is None:
                waiting.append(number)
                continue
            done(number)
            yield number, unpack(known)
        for number, answer in execute(
            self.executor, ((number, to_bytes(jobs[number])) for number in waiting)
        ):
            if isinstance(answer, WorkerDeath):
                done(number)
                yield number, Failure(answer.reason)
                continue
            try:
                result = unpack(answer)
            except ValueError as error:
                result = Failure(f"its worker answered something else: {error}")
            if self.journal is not None and not isinstance(result, Failure):
                self.journal.add(to_bytes(jobs[number]), answer)
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
                    yield unpack(early.read(places.pop(following)))
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
