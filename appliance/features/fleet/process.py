"""Run the client of bundles as a process of the appliance: lifeline, link to control, and two threads.

It reads no state of the appliance. It runs as a separate user, and the firewall lets it reach only the collector.
"""

import asyncio
import contextvars
import random
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import structlog

from appliance.base import clock
from appliance.base.input_files import read_given
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.configuration.settings import load_resolved
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered, BundlePollReported, BundleStated
from appliance.features.fleet.connection import CollectorConnection, CollectorError, robot_connection
from appliance.features.fleet.poller import Poller
from appliance.features.fleet.settings import Fleet
from appliance.features.fleet.verified_bundles import VerifiedBundles
from appliance.formats.bundle_api import EVENTS

_log = structlog.get_logger()
_TICK_SECONDS = 1.0
_LAST_SECONDS = 1.0
_AGAIN_SECONDS = (1.0, 2.0, 5.0, 15.0, 30.0)
_EVENT = b"event: selection"
_LEAST_SECONDS = 1.0  # between two polls that events cause
_SPREAD = 0.05  # of the interval
_LONGEST_SPREAD = 10.0
_LONGEST_ROOT = 1 << 18


def main(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Process(load_resolved(config).of(Fleet), lifeline_fd).run())


class PollLoop:
    """Polls in one thread. The other thread listens to events, which only make the next poll earlier.

    Polls are spread over some seconds, because all robots start or are woken at the same time.
    """

    def __init__(self, poller: Poller, events: CollectorConnection, path: str) -> None:
        self._poller = poller
        self._events = events
        self._path = path
        self._ending, self._wake = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []

    @property
    def alive(self) -> bool:
        """Return whether both threads run. Only a defect ends a thread early."""
        return all(thread.is_alive() for thread in self._threads)

    def start(self) -> None:
        """Start the threads as daemons: the end of the process does not wait for a hanging collector."""
        for work in (self._poll, self._listen):
            context = contextvars.copy_context()  # keeps the process name in the thread's log lines
            thread = threading.Thread(target=context.run, args=(work,), name=work.__name__, daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self, seconds: float) -> None:
        self._ending.set()
        self._wake.set()
        self._threads[0].join(seconds)

    def _poll(self) -> None:
        spread = min(_LONGEST_SPREAD, _SPREAD * self._poller.interval)
        due = clock.now() + _some_of(spread)
        while not self._ending.is_set():
            began = clock.now()
            if began >= due:
                due = clock.now() + self._poller.step()
            else:
                self._poller.report()
            if self._wake.wait(max(0.0, min(_TICK_SECONDS, due - clock.now()))):
                self._wake.clear()
                due = min(due, began + _LEAST_SECONDS + _some_of(spread))

    def _listen(self) -> None:
        listen(self._events, self._path, self._ending, self._wake.set)


class _Process:
    def __init__(self, fleet: Fleet, lifeline_fd: int) -> None:
        lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._child = Child(
            lifeline,
            BundleLink,
            said=self._said,
            linked=self._linked,
            lost=lambda _why: self._lost(),
        )
        self._stated: BundleStated | None = None
        self._told: BundlePollReported | None = None
        self._event_loop: asyncio.AbstractEventLoop | None = None
        self._poller = make_poller(fleet, Path.cwd(), lambda: self._stated, self._offer)
        place = f"{fleet.bundles.site}/{fleet.bundles.group}"
        self._loop = PollLoop(self._poller, robot_connection(*fleet.connection), f"{EVENTS}/{place}")

    async def run(self) -> None:
        self._event_loop = asyncio.get_running_loop()
        self._loop.start()
        self._child.attach(messages.Ready())
        while not self._child.ended.is_set():
            self._tell()
            try:
                async with asyncio.timeout(_TICK_SECONDS):
                    await self._child.ended.wait()
            except TimeoutError:
                if not self._loop.alive:
                    break  # the supervisor restarts the process
        await asyncio.to_thread(self._loop.stop, _LAST_SECONDS)

    def _said(self, message: messages.Message) -> None:
        if isinstance(message, BundleStated):
            self._stated = message

    def _linked(self) -> None:
        self._told = None
        self._tell()

    def _lost(self) -> None:
        self._stated = None  # control states its bundle again when it is back

    def _tell(self) -> None:
        progress = self._poller.progress
        if progress != self._told and self._child.tell(progress):
            self._told = progress

    def _offer(self, offered: BundleOffered) -> None:
        if self._event_loop is not None:
            self._event_loop.call_soon_threadsafe(self._child.tell, offered)


def _some_of(seconds: float) -> float:
    return random.uniform(0.0, seconds)  # noqa: S311  spreads load, protects nothing


def listen(
    connection: CollectorConnection, path: str, ending: threading.Event, wake: Callable[[], None]
) -> None:
    failures = 0
    while not ending.is_set():
        try:
            seen = b""
            for part in connection.events(path):
                failures = 0
                seen = seen[-len(_EVENT) :] + part
                if _EVENT in seen:
                    wake()
                    seen = b""
                if ending.is_set():
                    return
        except CollectorError as error:
            _log.debug("no events of the collector", reason=str(error))
        ending.wait(_AGAIN_SECONDS[min(failures, len(_AGAIN_SECONDS) - 1)])
        failures += 1


def make_poller(
    fleet: Fleet,
    folder: Path,
    stated: Callable[[], BundleStated | None],
    offer: Callable[[BundleOffered], object],
) -> Poller:
    wanted = fleet.bundles
    assert wanted.root is not None  # noqa: S101  the role runs only with it
    connection = robot_connection(*fleet.connection)
    bundles = VerifiedBundles(
        folder,
        read_given(wanted.root, _LONGEST_ROOT),
        connection,
        site=wanted.site,
        group=wanted.group,
        robot=fleet.robot,
    )
    return Poller(bundles, connection, (wanted.site, wanted.group), wanted.interval, stated, offer)
