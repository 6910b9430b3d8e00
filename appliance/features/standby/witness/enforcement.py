"""The enforcement of the lease on one computer: its firewall, its connections, regular checks, and a bounded log."""

import contextlib
import os
import select
import socket
import threading
import time
from typing import Any, Callable, Iterable, List, Optional, Tuple

from appliance.features.standby.witness.errors import PostponedError, WitnessError
from appliance.features.standby.witness.firewall import LeaseFirewall, always
from appliance.features.standby.witness.idle_connections import RESET_SECONDS, IdleConnections
from appliance.features.standby.witness.protocol import Left
from appliance.features.standby.witness.settings import WitnessSettings

CHECK_SECONDS = 1.0  # between two listings
_TRIAL_SECONDS = 10.0  # between two trials of the next rules
_SLOW_SECONDS = 5.0  # that a check may take
_LINES, _LINES_SECONDS = 20, 10.0


class RegularCheck:
    """Checks something regularly in a thread, so that neither a slow disk nor a slow program delays an answer.

    `check` raises `OSError` or `WitnessError`; then `failure` is the beginning of the reported text.
    """

    def __init__(self, failure: str, check: Callable[[], Any], clock: Callable[[], float]) -> None:
        self._text = failure
        self._check = check
        self._clock = clock
        self._began = None  # type: Optional[float]
        self._failure = ""

    def start(self, seconds: float) -> None:
        threading.Thread(target=self._run_always, args=(seconds,), daemon=True).start()

    def _run_always(self, seconds: float) -> None:
        while True:
            self.run()
            select.select([], [], [], CHECK_SECONDS if self._failure else seconds)

    def run(self) -> None:
        self._began = self._clock()
        try:
            self._check()
            self._failure = ""
        except PostponedError:
            pass
        except (OSError, WitnessError) as error:
            self._failure = "%s: %s" % (self._text, error)
        self._began = None

    def trouble(self) -> str:
        began = self._began
        if began is not None and self._clock() - began > _SLOW_SECONDS:
            return "%s: that takes more than %d s" % (self._text, _SLOW_SECONDS)
        return self._failure


class BoundedLog:
    """Lines on standard error; if there are more than a few in some seconds, only their number is printed."""

    def __init__(self, write: Callable[[str], Any], clock: Callable[[], float]) -> None:
        self._write = write
        self._clock = clock
        self._since = clock()
        self._lines = 0
        self._one = threading.Lock()

    def add(self, text: str) -> None:
        with self._one:
            self._add(text)

    def _add(self, text: str) -> None:
        now = self._clock()
        if now - self._since > _LINES_SECONDS:
            if self._lines > _LINES:
                self._write("%d more lines were left out\n" % (self._lines - _LINES))
            self._since, self._lines = now, 0
        self._lines += 1
        if self._lines <= _LINES:
            self._write(text + "\n")


def write_error(text: str) -> None:
    """Write to standard error; a text that cannot be written is lost, because it must not end the enforcement."""
    with contextlib.suppress(OSError):
        os.write(2, text.encode("utf-8", "backslashreplace"))


def report_ready() -> None:
    """Let systemd, if it runs this program, count the service as started."""
    address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.sendto(b"READY=1", socket.MSG_DONTWAIT, address)


class LeaseEnforcement:
    """The firewall and the idle connections of this computer. One thread uses all but the checks."""

    def __init__(
        self,
        firewall: LeaseFirewall,
        idle: IdleConnections,
        appliances: Iterable[str],
        log: BoundedLog,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.firewall = firewall
        self._idle = idle
        self._log = log
        self._names = sorted(appliances)
        self._clock = clock
        self._admitted = ""
        self._checked = self._reset = clock()
        self._changes = 0  # odd while rules are written
        self._listed = None  # type: Optional[Tuple[int, List[str]]]
        self.listing = RegularCheck("the firewall rules cannot be listed", self._list, clock)
        text = "the firewall rules of a takeover cannot be written"
        self.trial = RegularCheck(text, self._try_next, clock)

    def start_checks(self) -> None:
        self.listing.start(CHECK_SECONDS)
        self.trial.start(_TRIAL_SECONDS)

    def trouble(self) -> str:
        return self.listing.trouble() or self.trial.trouble()

    def _list(self) -> None:
        changes = self._changes
        present = self.firewall.present()
        if changes % 2 == 0:
            self._listed = changes, present

    def _try_next(self) -> None:
        self.firewall.try_out(next(name for name in self._names if name != self._admitted))

    def admit(self, name: str, left: Left = always) -> None:
        self._changes += 1
        try:
            connecting = self._idle.connecting()
            self.firewall.admit(name, left)
        finally:
            self._changes += 1
        self._admitted = name
        self._idle.reset(name, connecting)
        self._log.add("the robot admits %s" % (name or "no appliance"))

    def go_on(self, enforce_again: Callable[[], None]) -> bool:
        now = self._clock()
        if now - self._reset >= RESET_SECONDS:
            self._reset = now
            self._idle.go_on()
        listed, self._listed = self._listed, None
        try:
            if listed is not None and listed[0] == self._changes and not self.firewall.intact(listed[1]):
                cause = "another program changed the firewall rules of the witness"
                if not self.firewall.read:
                    cause = "the firewall rules of the witness could not be read after they were written"
                self._log.add(cause + "; they are written again")
                enforce_again()
        except WitnessError as error:
            self._log.add(str(error))
        if now - self._checked < CHECK_SECONDS:
            return False
        self._checked = now
        return True


def enforcement_of(settings: WitnessSettings, backend: str, log: BoundedLog) -> LeaseEnforcement:
    firewall, idle = LeaseFirewall(settings, backend), IdleConnections(settings)
    return LeaseEnforcement(firewall, idle, settings.appliances, log)
