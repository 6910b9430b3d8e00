"""Log the output of programs that are not ours (rosmaster, rosout) line by line, in the format of all other logs."""

import asyncio
import os
from typing import IO

import structlog

_LONGEST_LINE = 2000  # bytes; the rest of a longer line is a line of its own
_log = structlog.get_logger()


class ProgramOutput:
    """The reader of a program's output, until the program and all that it started have ended."""

    def __init__(self, role: str, output: IO[bytes], loop: asyncio.AbstractEventLoop) -> None:
        self._role = role
        self._output = output
        self._loop = loop
        self._rest = b""
        os.set_blocking(output.fileno(), False)
        loop.add_reader(output.fileno(), self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._output.fileno(), 1 << 16)
        except BlockingIOError:
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._rest and (not data or len(self._rest) > _LONGEST_LINE):
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            for start in range(0, len(line), _LONGEST_LINE):
                text = line[start : start + _LONGEST_LINE].decode("utf-8", "replace")
                _log.info("".join(c if c.isprintable() else "?" for c in text), process=self._role)
        if not data:
            self._loop.remove_reader(self._output.fileno())
            self._output.close()
