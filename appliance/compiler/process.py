"""Run the compiler: lifeline, link to control, and a worker thread.

1. The process has no network and no files. Specifications that exceed the limits of memory or processor time end
   only this process.
2. When the budget of processor time is used up, the compiler answers with a refusal, and the process ends (status
   0), because a thread cannot be stopped.
3. The process ends in the same way when control closes the link: without a link it gets no questions, and the
   supervisor starts no other compiler while it runs.
"""

import asyncio
import os
import resource
import socket

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.quotas.table import DRY_RUNS
from appliance.specifications import checking
from appliance.specifications.specification_files import SpecificationsRefusedError

_MEMORY = 1 << 30  # bytes of address space, of which the compiler's own libraries take 50 MiB
_WORK_SECONDS = 60  # seconds of processor time for one question of an order to load
_START_SECONDS = 2 * _WORK_SECONDS  # for both questions of an order, and the search for files with errors
_DRY_RUN_SECONDS = DRY_RUNS.bounds.host  # seconds of processor time for a dry run
_SPARE_SECONDS = 5  # seconds of processor time beyond the budget; then the kernel kills the process
_IDLE_SECONDS = 60.0


_Question = messages.ContentsWanted | messages.PartsWanted


def main(lifeline_fd: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    compiler = CompilerProcess(Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline))
    asyncio.run(compiler.run())
    # The lifeline stays open until the process has ended: the supervisor kills a process that closes it and still runs,
    # and would count that as a restart.
    os._exit(0)


class CompilerProcess:
    """The compiler's loop, which answers one question after the other."""

    def __init__(self, lifeline: Channel) -> None:
        self._child = Child(lifeline, messages.CompilerLink, said=self._said, lost=self._lost)
        self._asked: asyncio.Queue[_Question] = asyncio.Queue()

    async def run(self) -> None:
        self._child.attach(messages.Ready())
        ended = asyncio.ensure_future(self._child.ended.wait())
        while not ended.done():
            asked = asyncio.ensure_future(self._asked.get())
            await asyncio.wait((ended, asked), timeout=_IDLE_SECONDS, return_when=asyncio.FIRST_COMPLETED)
            if not asked.done():
                asked.cancel()
                break
            await self._work(asked.result())
        ended.cancel()
        self._child.close()

    async def _work(self, wanted: _Question) -> None:
        budget = _budget(wanted)
        ends = _used() + budget
        work = asyncio.ensure_future(asyncio.to_thread(answer, wanted))
        while not work.done() and (left := ends - _used()) > 0:
            await asyncio.wait((work,), timeout=max(left, 0.05))
        if work.done():
            if not self._child.tell(work.result()):
                self._lost("")
            return
        text = f"they take more than the {budget} s of processor time that {_purpose(wanted)} has to compile them"
        self._child.tell(messages.CompilationRefused(wanted.number, [text]))
        os._exit(0)

    def _lost(self, _reason: str) -> None:
        os._exit(0)

    def _said(self, message: object) -> None:
        if isinstance(message, _Question):
            self._asked.put_nowait(message)


def answer(wanted: _Question) -> messages.ContentsFound | messages.PartsMade | messages.CompilationRefused:
    ends = int(_used()) + _budget(wanted) + _SPARE_SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (ends, resource.RLIM_INFINITY))
    try:
        if isinstance(wanted, messages.PartsWanted):
            return messages.PartsMade(wanted.number, checking.parts(wanted.compiled, wanted.parts))
        if wanted.at_start:
            found = checking.contents_at_start(
                wanted.files, wanted.definitions, wanted.topics, lints=wanted.lints
            )
        elif wanted.broken:
            found = checking.contents_beside(wanted.files, wanted.definitions, wanted.broken, wanted.topics)
        else:
            found = checking.contents(
                wanted.files, wanted.definitions, load=wanted.dry_run, given_topics=wanted.topics
            )
        return messages.ContentsFound(wanted.number, found)
    except SpecificationsRefusedError as error:
        return messages.CompilationRefused(wanted.number, error.findings)
    except (MemoryError, SystemError):  # Python 3.11 reports some lack of memory as `SystemError`
        text = f"they take more than the {_MEMORY >> 20} MiB of memory available to compile them"
    except Exception as error:  # noqa: BLE001  a defect of the compiler is a reason to refuse, no more
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
    return messages.CompilationRefused(wanted.number, [text])


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _budget(wanted: _Question) -> int:
    match wanted:
        case messages.ContentsWanted(dry_run=True):
            return _DRY_RUN_SECONDS
        case messages.ContentsWanted(at_start=True):
            return _START_SECONDS
    return _WORK_SECONDS


def _purpose(wanted: _Question) -> str:
    match wanted:
        case messages.ContentsWanted(dry_run=True):
            return "a dry run"
        case messages.ContentsWanted(at_start=True):
            return "a start"
    return "a load"
