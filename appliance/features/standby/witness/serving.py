"""The command `serve`: answer the appliances and the followers."""

import contextlib
import os
import select
import socket
import time
from typing import Dict, List, Optional, Tuple

from appliance.features.standby.witness.enforcement import (
    BoundedLog,
    RegularCheck,
    enforcement_of,
    report_ready,
    write_error,
)
from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.lease_file import BOOT_ID, LeaseFile, LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import BATCH, FREEBIND, LONGEST
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import WitnessSettings

_EACH = 8  # datagrams of each known source in this time, so that a flood of one delays no renewal of another
_DISK_SECONDS = 30.0  # between two checks of the disk


def serve(settings: WitnessSettings, backend: str, lease: LeaseFile) -> None:
    log = BoundedLog(write_error, time.monotonic)
    enforcement = enforcement_of(settings, backend, log)
    try:
        record = lease.read()  # type: Optional[LeaseRecord]
    except WitnessError as error:
        record = None
        log.add(str(error))
    with open(BOOT_ID, encoding="ascii") as file:
        boot = file.read().strip()
    witness = Witness(
        record=record, save=lease.write, admit=enforcement.admit, boot=boot, clock=time.monotonic
    )
    gate = WitnessGate(witness, settings.appliances, os.urandom(16).hex(), settings.followers)
    disk = RegularCheck(
        "the disk of the lease %s cannot be written" % lease.path, lease.check_disk, time.monotonic
    )
    disk.start(_DISK_SECONDS)
    enforcement.start_checks()
    with RequestSockets(settings.listen) as requests:
        log.add("the witness answers at %s:%d and uses %s" % (*settings.listen, backend))
        report_ready()
        rejected = 0
        while True:  # until the process is ended; each turn is bounded
            for one, most in requests.ready():
                for _ in range(most):
                    if not _answer_one(one, gate, requests):
                        break
            if not enforcement.go_on(witness.enforce_again):
                continue
            witness.unknown_rules = enforcement.trouble()
            _note_trouble(witness, lease, disk, log)
            if gate.rejected > rejected:
                log.add("%d requests without a valid authentication code" % (gate.rejected - rejected))
                rejected = gate.rejected


def _note_trouble(witness: Witness, lease: LeaseFile, disk: RegularCheck, log: BoundedLog) -> None:
    """Put into answers why the next takeover would fail. If the file lacks space, try to get it."""
    trouble = ""
    if witness.record is not None:
        trouble = witness.unknown_rules or disk.trouble()
        if not disk.trouble() and (witness.unsettled or not lease.has_room()):
            try:
                witness.settle()
            except WitnessError as error:
                trouble = str(error)
    if trouble != witness.trouble:
        log.add(trouble or "nothing prevents a takeover now")
    witness.trouble = trouble


class RequestSockets:
    """The sockets for requests: one for all hosts, and one for each appliance and follower since its last new
    request.

    The kernel gives datagrams from the address *and port* of that request to the connected socket. Another host
    cannot guess this port, so datagrams with a forged address fill only the buffer of the common socket.
    """

    def __init__(self, listen: Tuple[str, int]) -> None:
        self._listen = listen
        self._common = self._bind()
        self._connected = {}  # type: Dict[str, Tuple[socket.socket, Tuple[str, int]]]

    def __enter__(self) -> "RequestSockets":
        return self

    def __exit__(self, *_: object) -> None:
        for one in [self._common] + [one for one, _ in self._connected.values()]:
            one.close()

    def ready(self) -> List[Tuple[socket.socket, int]]:
        connected = [one for one, _ in self._connected.values()]
        found, _, _ = select.select([*connected, self._common], [], [], 0.2)
        return [(one, BATCH if one is self._common else _EACH) for one in found]

    def prefer(self, name: str, source: Tuple[str, int]) -> None:
        """Connect a socket to the source of a new request. If that raises `OSError`, the common socket serves it."""
        before = self._connected.get(name)
        if before is not None and before[1] == source:
            return
        one = self._bind()
        try:
            one.connect(source)
        except OSError:
            one.close()
            raise
        self._connected[name] = (one, source)
        if before is not None:
            before[0].close()

    def _bind(self) -> socket.socket:
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            one.setsockopt(socket.SOL_IP, FREEBIND, 1)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)  # only for sockets of the same user
            one.bind(self._listen)
        except OSError as error:
            one.close()
            text = "UDP %s:%d: %s; another program may have the port: sudo ss -lunp"
            raise OSError(error.errno, text % (*self._listen, error.strerror)) from error
        one.setblocking(False)
        return one


def _answer_one(one: socket.socket, gate: WitnessGate, requests: RequestSockets) -> bool:
    try:
        datagram, source = one.recvfrom(LONGEST + 1)
    except BlockingIOError:
        return False
    except OSError:
        return True  # an earlier answer was not delivered
    answer = gate.answer(datagram, source[0])
    with contextlib.suppress(OSError):  # no route to the appliance at present; it asks again
        if answer is not None:
            one.sendto(answer, source)
        if gate.fresh:
            requests.prefer(gate.fresh, source)
    return True
