"""Open the operator's files for a role whose user may not reach them, such as a policy in a home of mode 0700.

Only a path that the role's row lists is opened. A thread answers, because a file system may block.
"""

import contextlib
import errno
import os
import socket
import threading
from collections.abc import Collection
from pathlib import Path

from appliance.base.owner_access import open_as_owner, open_below

_LONGEST_PATH = 4096
_ERROR_BYTES = 4  # an answer: an error number, or 0 and a descriptor
_NOT_AN_INPUT = (1 << 32) - 1
_BESIDE = ("", ".sig", ".tests.yaml")
_ANSWER_SECONDS = 0.5  # RVMaster may wait for it


class Borrower:
    """The role's end. A supervisor that hangs delays the role once, not at each request."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._asking = threading.Lock()
        self._is_owed = False  # the answer to an earlier request

    def open(self, path: Path) -> int | None:
        """Return a descriptor of an input, None for any other path. Raises `OSError`, such as `TimeoutError`."""
        with self._asking:
            if self._is_owed:
                for late in self._answer(path, 0)[1]:
                    os.close(late)
            self._link.settimeout(_ANSWER_SECONDS)
            self._link.send(os.fsencode(path))
            answer, descriptors = self._answer(path, _ANSWER_SECONDS)
        for descriptor in descriptors:
            os.set_inheritable(descriptor, False)
            return descriptor
        number = int.from_bytes(answer)
        if number == _NOT_AN_INPUT:
            return None
        raise OSError(number, os.strerror(number), str(path))

    def _answer(self, path: Path, seconds: float) -> tuple[bytes, list[int]]:
        self._is_owed = True
        self._link.settimeout(seconds)
        try:
            answer, descriptors, _flags, _address = socket.recv_fds(self._link, _ERROR_BYTES, 1)
        except (BlockingIOError, TimeoutError):
            text = "the supervisor did not open the file in time; try again, or see rosrv status"
            raise TimeoutError(errno.ETIMEDOUT, text, str(path)) from None
        self._is_owed = False
        return answer, descriptors


def lend_inputs(inputs: Collection[Path]) -> socket.socket | None:
    """Return the role's socket, or None if the role has the supervisor's rights anyway."""
    if not inputs or os.geteuid() != 0:
        return None
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    threading.Thread(target=_serve, args=(here, tuple(inputs)), name="input lender", daemon=True).start()
    return there


def _serve(link: socket.socket, inputs: tuple[Path, ...]) -> None:
    with link, contextlib.suppress(OSError):  # the role has ended
        while wanted := link.recv(_LONGEST_PATH):
            try:
                descriptor = open_input(Path(os.fsdecode(wanted)), inputs)
            except OSError as error:
                link.send((error.errno or errno.EACCES).to_bytes(_ERROR_BYTES))
                continue
            if descriptor is None:
                link.send(_NOT_AN_INPUT.to_bytes(_ERROR_BYTES))
                continue
            try:
                socket.send_fds(link, [bytes(_ERROR_BYTES)], [descriptor])
            finally:
                os.close(descriptor)


def open_input(path: Path, inputs: Collection[Path]) -> int | None:
    """Return a descriptor if the path is an input, or a file beside or below one, else None. Raises `OSError`."""
    for given in inputs:
        if any(path == given.with_name(given.name + suffix) for suffix in _BESIDE):
            return open_as_owner(path)
        if path.is_relative_to(given) and ".." not in path.parts[len(given.parts) :]:
            return open_below(given, path)
    return None
