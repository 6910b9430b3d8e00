"""Run the client of bundles as a process of the appliance: lifeline, link to control, and two threads.

It reads no state of the appliance. It runs as a separate user, and the firewall lets it reach only the collector.
"""

import asyncio
import contextvars
import random
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from appliance.base.input_files import read_given
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.configuration.settings import load_resolved
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered, BundlePollReported, BundleStated
from appliance.features.fleet.connection import CollectorConnection, CollectorError, robot_connection
from appliance.features.fleet.settings import Fleet
from appliance.features.fleet.verified_bundles import (
    BundleFolderError,
    BundleRejectedError,
    BundleTooEarlyError,
    SelectedBundle,
    VerifiedBundle,
    VerifiedBundles,
)
from appliance.formats.bundle_api import EVENTS, REPORT, RobotReport

# Poll the collector: verify its metadata, offer the selected bundle to control, and report the robot's state.
#
# Only bundles that `VerifiedBundles` has accepted are offered. A refused bundle is not offered again until the
# collector selects another one.

_BACK_OFF = (1.0, 2.0, 5.0, 15.0, 30.0, 60.0)
_JITTER = 0.2  # of the pause, in both directions
_REPORT_SECONDS = 30.0
_REPORT_AGAIN_SECONDS = 5.0


@dataclass(slots=True)
class Poller:
    """Polls the collector. `stated()` returns control's last statement; `offer` sends a bundle to control."""

    bundles: VerifiedBundles
    connection: CollectorConnection
    place: tuple[str, str]  # site and group
    interval: float
    stated: Callable[[], BundleStated | None]
    offer: Callable[[BundleOffered], object]
    clock: Callable[[], float] = clock.wall
    progress: BundlePollReported = field(default_factory=BundlePollReported)
    _failures: int = 0
    _reported: RobotReport | None = None
    report_due: float = 0.0
    _early: str = ""
    _retry_at: float = 0.0

    def step(self) -> float:
        stated = self.stated()
        if stated is None:
            return _jitter(_BACK_OFF[0])
        pause = self._check(stated)
        self._report(self.stated() or stated)
        return pause

    def report(self) -> None:
        stated = self.stated()
        if stated is not None:
            self._report(stated)

    def _check(self, stated: BundleStated) -> float:
        self._early, offers = "", False
        try:
            self.bundles.refresh()
            selected = self.bundles.fetch_selected()
            if selected is not None and _is_news(selected, stated):
                self.offer(_offer(self.bundles.get(selected)))
                offers = True
        except BundleTooEarlyError as error:
            self._early = str(error)
            pause = max(1.0, error.at - self.clock())
        except (BundleRejectedError, BundleFolderError, CollectorError) as error:
            return self._failed(error)
        else:
            pause = self.interval
        if self._failures:
            _log.warning("the collector's bundles are verified again")
        self._failures = 0
        self.progress = BundlePollReported(self.clock(), offered=offers)
        return _jitter(min(self.interval, pause))

    def _failed(self, error: Exception) -> float:
        if not self._failures:
            _log.error("the collector's bundles cannot be verified; trying again", reason=str(error))
        pause = _BACK_OFF[min(self._failures, len(_BACK_OFF) - 1)]
        self._failures += 1
        self.progress = BundlePollReported(
            self.progress.checked, str(error)[:1000], isinstance(error, BundleRejectedError)
        )
        return _jitter(min(pause, self.interval))

    def _report(self, stated: BundleStated) -> None:
        refused = stated.refused
        report = RobotReport(
            *self.place,
            stated.in_force,
            stated.trying,
            "" if refused is None else refused.path,
            "" if refused is None else refused.reason[:1000],
            stated.changed,
            stated.health.denials,
            stated.health.failing,
            self.progress.trouble or stated.waits or self._early,
        )
        now = clock.now()
        pressing = self._reported is None or _fate_of(report) != _fate_of(self._reported)
        if now < (self._retry_at if pressing else self.report_due):
            return
        try:
            body = msgspec.json.encode(report)
            self.connection.put(REPORT, iter([body]), len(body), [("Content-Type", "application/json")])
        except CollectorError as error:
            self._retry_at = self.report_due = now + _jitter(_REPORT_AGAIN_SECONDS)
            if not self.progress.trouble:
                self.progress = BundlePollReported(self.progress.checked, str(error)[:1000])
            return
        self._reported, self.report_due = report, now + _jitter(_REPORT_SECONDS)


def _fate_of(report: RobotReport) -> RobotReport:
    return msgspec.structs.replace(report, denials=0, failing=0)


def _is_news(selected: SelectedBundle, stated: BundleStated) -> bool:
    """Return whether control has not yet decided about these bytes: a path can be signed again with others."""
    bundle, refused = (str(selected.path), selected.sha256), stated.refused
    if bundle[0] == stated.trying:  # other bytes of the same path wait for the end of the trial
        return False
    return bundle not in ((stated.in_force, stated.sha256), refused and (refused.path, refused.sha256))


def _offer(bundle: VerifiedBundle) -> BundleOffered:
    return BundleOffered(str(bundle.path), bundle.sha256, bundle.contents)


def _jitter(seconds: float) -> float:
    """Vary a pause, so that robots do not ask at the same time."""
    return seconds * random.uniform(1 - _JITTER, 1 + _JITTER)  # noqa: S311  spreads load, protects nothing


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
            linked=self._on_link,
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

    def _on_link(self) -> None:
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
