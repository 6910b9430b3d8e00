"""The command `follow`: ask the witness, and do as it does."""

import contextlib
import os
import select
import socket
import threading
import time
import traceback
from typing import Callable, Iterable, Tuple

from appliance.features.standby.witness.enforcement import (
    CHECK_SECONDS,
    BoundedLog,
    enforcement_of,
    report_ready,
    write_error,
)
from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.follower import LOOK_SECONDS, WitnessFollower
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.protocol import BATCH, EXPIRY, FREEBIND, HIGHEST, LONGEST
from appliance.features.standby.witness.settings import WitnessSettings

_CLOCK_BOOTTIME = 7  # runs while the computer sleeps; Python 3.5 does not name it
_MAX_WAKES = 4096  # that one wait takes


def follow(settings: WitnessSettings, backend: str, lease: LeaseFile) -> None:
    log = BoundedLog(write_error, time.monotonic)
    enforcement = enforcement_of(settings, backend, log)
    names = tuple(sorted(settings.appliances))
    own = settings.followers[settings.follows_as]
    follower = WitnessFollower(
        name=settings.follows_as,
        key=own.key,
        appliances=names,
        session=os.urandom(16).hex(),
        epoch=followed_epoch(lease, log),
        save=lambda epoch: lease.write(LeaseRecord(epoch, "", names, "")),
        admit=enforcement.admit,
        clock=_boot_seconds,
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.SOL_IP, FREEBIND, 1)
        asking.bind((own.address, 0))
        asking.setblocking(False)
        log.add(
            "%s follows the witness at %s:%d and uses %s" % (settings.follows_as, *settings.listen, backend)
        )
        report_ready()
        enforcement.start_checks()
        writing, saving = Wake(), Wake()
        _start(lambda: _ask_always(asking, settings.listen, follower, (writing, saving)))
        _start(lambda: _save_always(follower, (writing, saving), log))
        shown = ""
        while True:  # until the process is ended; each turn is bounded
            writing.wait(follower.pause())
            try:
                follower.tick()
            except WitnessError as error:
                log.add(str(error))
            follower.note(enforcement.trouble())
            silent = _boot_seconds() - follower.answered > EXPIRY
            state = "the witness at %s:%d does not answer" % settings.listen if silent else follower.refusal
            state = state or follower.report
            if state != shown:
                shown = state
                log.add(state or "the witness answers, and the rules can be written")
            enforcement.go_on(follower.enforce_again)


class Wake:
    """Wakes a waiting thread. Unlike those of `threading`, a wait is not prolonged by a change of the wall clock,
    which Python before 3.11 uses for them.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)

    def set(self) -> None:
        with contextlib.suppress(BlockingIOError):  # it has enough to wake for
            self._writer.send(b".")

    def wait(self, seconds: float) -> None:
        ready, _, _ = select.select([self._reader], [], [], max(0.0, seconds))
        if ready:
            self._reader.recv(_MAX_WAKES)


def _start(run: Callable[[], None]) -> None:
    """Run a thread, without which the process must end."""

    def run_or_end() -> None:
        try:
            run()
        except Exception:  # noqa: BLE001  whatever it is: systemd starts the program again
            traceback.print_exc()
        os._exit(1)

    threading.Thread(target=run_or_end, daemon=True).start()


def _ask_always(
    asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower, wakes: Iterable[Wake]
) -> None:
    asked = time.monotonic() - LOOK_SECONDS
    while True:
        left = asked + LOOK_SECONDS - time.monotonic()
        ready, _, _ = select.select([asking], [], [], max(0.0, left))
        for _ in range(BATCH if ready else 0):
            if not _receive_one(asking, witness, follower):
                break
        for wake in wakes if ready else ():
            wake.set()
        if time.monotonic() - asked >= LOOK_SECONDS:
            asked = time.monotonic()
            _send_look(asking, witness, follower)


def _save_always(follower: WitnessFollower, wakes: Tuple[Wake, Wake], log: BoundedLog) -> None:
    writing, saving = wakes
    while True:
        saving.wait(CHECK_SECONDS)
        try:
            if follower.save_epoch():
                writing.set()
        except WitnessError as error:
            log.add(str(error))


def _boot_seconds() -> float:
    return time.clock_gettime(_CLOCK_BOOTTIME)


def followed_epoch(lease: LeaseFile, log: BoundedLog) -> int:
    """Return the greatest epoch that this follower saved. If the file is damaged, no answer is new enough."""
    if not os.path.exists(lease.path):
        return 0
    try:
        return lease.read().epoch
    except WitnessError as error:
        log.add(
            "the epoch %s cannot be used: %s; both appliances are shut out. If the lease of the witness was not"
            " restored from an older disk: rm %s; systemctl restart rosrv-witness-follow"
            % (lease.path, error.__cause__, lease.path)
        )
        return HIGHEST


def _send_look(asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower) -> None:
    with contextlib.suppress(OSError):  # no route to the witness at present; it is asked again
        asking.sendto(follower.request(), witness)


def _receive_one(asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower) -> bool:
    try:
        datagram, source = asking.recvfrom(LONGEST + 1)
    except BlockingIOError:
        return False
    except OSError:
        return True  # an earlier request was not delivered
    if source == witness:
        follower.receive(datagram)
    return True
