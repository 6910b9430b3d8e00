"""The compiler as a process of the appliance: lifeline, link to control, and a thread that works.

Invariants:

1. It has no network and no file: what it reads are the messages of its lifeline and its link to control.
2. Texts that take more memory or processor time than there is for them end it, and nothing else.
3. It is there while it is needed: when nobody has asked for `_IDLE_SECONDS` it ends, with exit status 0.
"""

import asyncio
import resource
import socket
from typing import Any

from appliance import late
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child import Child
from appliance.specifications.files import SpecificationsRefusedError

_MEMORY = 1 << 30  # bytes of addresses: its own libraries are 50 MiB of that
_WORK_SECONDS = 60  # of processor time, for one question
_IDLE_SECONDS = 60.0


_Question = messages.ContentsWanted | messages.PartsWanted


def main(lifeline_fd: int) -> None:
    """Read specifications until nobody asks, or the supervisor ends it."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    asyncio.run(Process(Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)).run())


class Process:
    """Answers one question after the other."""

    def __init__(self, lifeline: Channel) -> None:
        self._child = Child(lifeline, messages.CompilerLink, said=self._said)
        self._asked: asyncio.Queue[_Question] = asyncio.Queue()

    async def run(self) -> None:
        """Work from start to end."""
        self._child.attach(messages.Ready())
        ended = asyncio.ensure_future(self._child.ended.wait())
        while not ended.done():
            asked = asyncio.ensure_future(self._asked.get())
            await asyncio.wait((ended, asked), timeout=_IDLE_SECONDS, return_when=asyncio.FIRST_COMPLETED)
            if not asked.done():
                asked.cancel()
                break
            self._child.tell(await asyncio.to_thread(answer, asked.result()))
        ended.cancel()
        self._child.close()

    def _said(self, message: Any) -> None:
        if isinstance(message, _Question):
            self._asked.put_nowait(message)


def answer(wanted: _Question) -> messages.ContentsFound | messages.PartsMade | messages.CompilationRefused:
    """What is in these texts, or all that is wrong with them; or what relays run of them."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    ends = int(used.ru_utime + used.ru_stime) + _WORK_SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (ends, resource.RLIM_INFINITY))
    try:
        checking = late.load("appliance.specifications.checking")
        if isinstance(wanted, messages.PartsWanted):
            return messages.PartsMade(wanted.number, checking.parts(wanted.compiled, wanted.parts))
        return messages.ContentsFound(wanted.number, checking.contents(wanted.files, wanted.definitions))
    except SpecificationsRefusedError as error:
        return messages.CompilationRefused(wanted.number, error.findings)
    except (MemoryError, SystemError):  # what Python 3.11 makes of some errors of the first kind
        text = f"they take more than the {_MEMORY >> 20} MiB of memory that there are to compile them"
    except Exception as error:  # noqa: BLE001  a defect of the compiler is a reason to refuse, no more
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
    return messages.CompilationRefused(wanted.number, [text])
