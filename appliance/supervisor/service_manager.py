"""Notify systemd of the state of the appliance (sd_notify(3)).

systemd's watchdog covers the supervisor's loop; that loop watches the other processes.
"""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Mapping, MutableMapping
from contextlib import asynccontextmanager, suppress

_WITHOUT_WATCHDOG = 30.0
_MORE = "EXTEND_TIMEOUT_USEC=120000000\n"
_READY = "READY=1\n"


class ServiceManager:
    """Notifies systemd; does nothing without systemd's socket."""

    def __init__(self, address: str | None, watchdog_seconds: float | None) -> None:
        self._address = None if address is None else address.replace("@", "\0", 1)
        self.watchdog_seconds = watchdog_seconds
        self._starting = True

    @classmethod
    def of(cls, environment: MutableMapping[str, str]) -> "ServiceManager":
        """Return the manager of this environment, from which it removes its variables: children inherit them."""
        said = {
            name: environment.pop(name, None) for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
        }
        return cls(said["NOTIFY_SOCKET"], _seconds(said))

    @property
    def is_present(self) -> bool:
        return self._address is not None

    def starting(self, status: str) -> None:
        """Report a status, and request more time."""
        self._say(f"{_MORE}STATUS={status}")

    def ready(self, status: str) -> None:
        self._starting = False
        self._say(f"{_READY}STATUS={status}")

    def stopping(self) -> None:
        self._say("STOPPING=1\nSTATUS=stopping its processes, then removing its firewall")

    @asynccontextmanager
    async def watch(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self._live())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _live(self) -> None:
        while True:
            # READY again, because systemd may not have read the first
            self._say(f"{_MORE if self._starting else _READY}WATCHDOG=1")
            await asyncio.sleep((self.watchdog_seconds or _WITHOUT_WATCHDOG) / 2)

    def _say(self, text: str) -> None:
        if self._address is None:
            return
        # A lost message is less than a supervisor that waits for systemd, or whose watchdog task has ended.
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.connect(self._address)
            notify.send(text.encode(), socket.MSG_DONTWAIT)


def _seconds(said: Mapping[str, str | None]) -> float | None:
    text, pid = said["WATCHDOG_USEC"], said["WATCHDOG_PID"]
    if text is None or not text.isdigit() or int(text) == 0 or (pid is not None and pid != str(os.getpid())):
        return None
    return int(text) / 1e6
