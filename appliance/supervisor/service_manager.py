"""What systemd is told of the appliance, where systemd started it (`Type=notify`, `WatchdogSec`).

While the appliance starts, systemd is asked for more time: the supervisor itself gives up a start that gets nowhere.

The protocol is sd_notify(3): a datagram of `KEY=value` lines to the socket that `NOTIFY_SOCKET` names. Without that
variable nothing is said. The process that systemd started is the supervisor; its watchdog stands for the supervisor's
loop, which itself watches the other processes.
"""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Mapping, MutableMapping
from contextlib import asynccontextmanager, suppress

_WITHOUT_WATCHDOG = 30.0
_MORE = "EXTEND_TIMEOUT_USEC=120000000\n"


class ServiceManager:
    """The socket of the service manager, and how often it wants to hear; says nothing where there is none."""

    def __init__(self, address: str | None, watchdog_seconds: float | None) -> None:
        self._address = None if address is None else address.replace("@", "\0", 1)
        self.watchdog_seconds = watchdog_seconds
        self._starting = True

    @classmethod
    def of(cls, environment: MutableMapping[str, str]) -> "ServiceManager":
        """As the environment says; taken out of it, so that no process of ours speaks to systemd in its place."""
        said = {
            name: environment.pop(name, None) for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
        }
        return cls(said["NOTIFY_SOCKET"], _seconds(said))

    def starting(self, status: str) -> None:
        """It gets on with its start, and asks for time; `status` is what it does now."""
        self._say(f"{_MORE}STATUS={status}")

    def ready(self, status: str) -> None:
        """The appliance serves; `status` is what `systemctl status` shows."""
        self._starting = False
        self._say(f"READY=1\nSTATUS={status}")

    def stopping(self) -> None:
        """It ends in order."""
        self._say("STOPPING=1\nSTATUS=ending its processes, then taking its firewall away")

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """Say for the length of the block that the loop runs, twice in each time that the watchdog grants."""
        task = asyncio.create_task(self._live())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _live(self) -> None:
        while True:
            self._say(f"{_MORE if self._starting else ''}WATCHDOG=1")
            await asyncio.sleep((self.watchdog_seconds or _WITHOUT_WATCHDOG) / 2)

    def _say(self, text: str) -> None:
        if self._address is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, suppress(OSError):
            # Nobody hears it: systemd then does what it does with a service that says nothing.
            notify.connect(self._address)
            notify.send(text.encode())


def _seconds(said: Mapping[str, str | None]) -> float | None:
    """Of the watchdog; None where it is meant for another process or is no number."""
    text, pid = said["WATCHDOG_USEC"], said["WATCHDOG_PID"]
    if text is None or not text.isdigit() or int(text) == 0 or (pid is not None and pid != str(os.getpid())):
        return None
    return int(text) / 1e6
