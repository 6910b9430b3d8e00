"""Open what the relays need for the heartbeat: their common memory, and the serial line.

A relay may open neither: its sandbox permits no device, and it gets the one descriptor.
"""

import fcntl
import os
import termios
from collections.abc import Iterator

from appliance.channel.messages import HeartbeatGiven

_WORDS = 16  # bytes of each relay (`relay/monitors/heartbeat.py`)
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class HeartbeatWiring:
    """The memory of all relays; `line` is the path of the serial line, or an empty text."""

    def __init__(self, relays: int, line: str) -> None:
        self._line = line
        self._memory = os.memfd_create("rosrv-heartbeat", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(self._memory, _WORDS * relays)
        fcntl.fcntl(self._memory, fcntl.F_ADD_SEALS, _SEALS)  # no relay can take it from the others

    def messages_for(self, role: str) -> Iterator[tuple[HeartbeatGiven, int]]:
        """Yield the message and the descriptor for the start of a process."""
        if role == "relay":
            yield HeartbeatGiven(), self._memory

    def open_line(self) -> int:
        """Open the serial line: 9600 baud, 8N1, without flow control. Raises `OSError` with the reason."""
        if not self._line:
            raise OSError("the appliance has no serial line (relay.heartbeat_line)")
        descriptor = os.open(self._line, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            flags = termios.tcgetattr(descriptor)
            flags[:4] = [termios.IGNBRK, 0, termios.CS8 | termios.CLOCAL | termios.CREAD, 0]
            flags[4] = flags[5] = termios.B9600
            termios.tcsetattr(descriptor, termios.TCSANOW, flags)
        except termios.error as error:
            os.close(descriptor)
            raise OSError(f"{self._line} is not a serial line: {error.args[-1]}") from error
        return descriptor

    def close(self) -> None:
        os.close(self._memory)
        self._memory = -1
