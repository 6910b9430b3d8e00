"""Run the lease as a process, which talks to the witness, the other appliance, the supervisor and control.

It does nothing else, so neither a busy nor a restarted control loses the lease. The epoch is on the disk before
it is used.

This appliance claims only while its control is present, which a standby withdraws while it could not serve
(`passive.py`). `ServiceWatch` decides when an active appliance gives the lease away.
"""

import asyncio
import contextlib
import secrets
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Self

import msgspec
import structlog

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.features.standby import lease_link
from appliance.features.standby.lease import (
    SILENCE,
    ApplianceLease,
    ClaimPromise,
    LeaseError,
    Outgoing,
    PeerMessage,
    PromiseRequest,
    TakeOver,
    WitnessAnswer,
    WitnessRequest,
)
from appliance.features.standby.membership import Membership, load_membership
from appliance.features.standby.witness.lease_file import write_synced
from appliance.features.standby.witness.protocol import (
    ANSWER,
    EXPIRY,
    HIGHEST,
    REQUEST,
    name_in,
    seal,
    unseal,
)

# The datagrams between an appliance and the witness.

_MAX_PENDING = 32

_Count = Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)]


class _AnswerBody(WitnessAnswer, frozen=True, kw_only=True):
    boot: str
    session: str
    number: _Count
    stale: bool = False
    last: _Count = 0


class WitnessChannel:
    """Writes requests and reads answers. `session` is a nonce of this process, so no earlier answer has it."""

    def __init__(self, name: str, key: bytes, session: str) -> None:
        self._name = name
        self._key = key
        self._session = session
        self._boot = ""
        self._number = 0
        self._pending: dict[int, WitnessRequest] = {}

    def write(self, request: WitnessRequest) -> bytes:
        self._number += 1
        self._pending[self._number] = request
        if len(self._pending) > _MAX_PENDING:
            del self._pending[next(iter(self._pending))]
        body = {
            "boot": self._boot,
            "session": self._session,
            "number": self._number,
            "do": request.operation,
            "epoch": request.epoch,
        }
        return seal(REQUEST, self._name, self._key, body)

    def read(self, datagram: bytes) -> tuple[WitnessRequest, WitnessAnswer] | None:
        """Return an answer with its request.

        If the nonce or number of the request was old, the answer has only the present ones, for the next request.
        """
        if name_in(datagram) != self._name:
            return None
        try:
            body = msgspec.convert(unseal(ANSWER, self._key, datagram), _AnswerBody)
        except msgspec.ValidationError:
            return None
        request = self._pending.pop(body.number, None) if body.session == self._session else None
        if request is None:
            return None
        if body.stale:
            self._boot, self._number = body.boot, max(self._number, body.last)
            return None
        return request, body


# Judge whether the control of an active appliance serves the robot, by its reports.
#
# An appliance that holds the lease without serving is worse than none, because the other one sees a healthy holder. So
# the lease is given away when control reports an obstacle (a full disk), is silent, or does not get ready.
#
# A control that died has `RESTART_SECONDS`, because topics and monitors need no control. After a lapse there are no
# relays, so the other appliance takes over sooner, unless a monitor would lose its state and hold its topics.
#
# Each appliance gives the lease away once in `AGAIN_SECONDS`, or after it has served for `STEADY_SECONDS`, so that two
# which cannot serve do not keep passing it back and forth, whatever the reason. The one that has it then keeps it, and
# reports why it does not serve.

OBSTACLE_SECONDS = EXPIRY  # another process may lock the log for a moment
SILENT_SECONDS = 4.0  # the supervisor kills a silent control after 5 s; its next start takes seconds
START_SECONDS = 5.0
RESTART_SECONDS = 10.0
AGAIN_SECONDS = 600.0
STEADY_SECONDS = 60.0


class ServiceWatch:
    """The reports of control while this appliance is active."""

    def __init__(self) -> None:
        self._active = False
        self._cold = False
        self._keeps_state = True
        self._served = 0.0  # time of the last report without an obstacle; at first of the activation
        self._serves = False  # whether the present control has served
        self._ready: float | None = None  # time of the first report without an obstacle in this activation
        self._obstacle = ""
        self._obstacle_since = 0.0
        self._given_at = float("-inf")
        self._steady: float | None = None  # since when this control has reported no obstacle

    def linked(self) -> None:
        self._serves, self._obstacle, self._steady = False, "", None

    def reported(self, now: float, obstacle: str, *, keeps_state: bool) -> None:
        self._keeps_state = keeps_state
        if not obstacle:
            self._served, self._serves, self._cold = now, True, False
            self._ready = now if self._ready is None else self._ready
            self._steady = now if self._steady is None else self._steady
            if now - self._steady > STEADY_SECONDS:
                self._given_at = float("-inf")
        elif not self._obstacle:
            self._obstacle_since, self._steady = now, None
        self._obstacle = obstacle

    def fault(self, now: float, *, active: bool, present: bool = True) -> str:
        """Note whether the lease is held (`active`), and whether control stands by or serves (`present`); return why
        this appliance does not serve, or an empty string.
        """
        if active and not self._active:
            self._served, self._cold = now, not present
            self._ready = None
            self.linked()
        self._active = active
        if not active:
            return ""
        if self._cold and not self._keeps_state:
            return "control has just started when the lease came back"
        if self._obstacle:
            return self._obstacle if now - self._obstacle_since > OBSTACLE_SECONDS else ""
        silent = now - self._served
        limit = START_SECONDS if self._ready is None else RESTART_SECONDS
        if silent <= (SILENT_SECONDS if self._serves else limit):
            return ""
        what = "has not reported" if self._serves else "has not been ready"
        return f"control {what} for {silent:.1f} s"

    def given_away(self, now: float) -> None:
        self._given_at = now

    def kept_for(self, now: float) -> float:
        """Return the seconds for which this appliance keeps the lease although it does not serve."""
        return max(0.0, self._given_at + AGAIN_SECONDS - now)


# The datagrams between two appliances, each authenticated with a shared key.
#
# A promise repeats the nonce and the number of its request. An active appliance uses one nonce per epoch, so a request
# is new only if it has a greater epoch, or the same nonce and a greater number.

PURPOSES: dict[type[PeerMessage], bytes] = {
    PromiseRequest: b"rosrv promise request 1\0",
    ClaimPromise: b"rosrv promise 1\0",
    TakeOver: b"rosrv take over 1\0",
}


class PeerChannel:
    """Seals and unseals the datagrams of one end."""

    def __init__(self, name: str, other: str, key: bytes) -> None:
        self._name = name
        self._other = other
        self._key = key
        self._last: PromiseRequest | None = None

    def write(self, message: PeerMessage) -> bytes:
        return seal(PURPOSES[type(message)], self._name, self._key, msgspec.to_builtins(message))

    def read(self, datagram: bytes) -> PeerMessage | None:
        if name_in(datagram) != self._other:
            return None
        for kind, purpose in PURPOSES.items():
            body = unseal(purpose, self._key, datagram)
            if body is not None:
                try:
                    message = msgspec.convert(body, kind)
                except msgspec.ValidationError:
                    return None
                fits = 0 <= message.epoch <= HIGHEST and 0 <= message.number <= HIGHEST
                return message if fits and self._is_new(message) else None
        return None

    def _is_new(self, message: PeerMessage) -> bool:
        if not isinstance(message, PromiseRequest):
            return True  # the caller compares a promise or order with its request
        last = self._last
        new = (
            last is None
            or message.epoch > last.epoch
            or (
                (message.epoch, message.session) == (last.epoch, last.session)
                and message.number > last.number
            )
        )
        if new:
            self._last = message
        return new


EPOCH = "epoch"
_CONTROL_SECONDS = 1.0
_LARGEST = 2048
_BATCH = 64  # datagrams between two ticks
_EPOCH_BYTES = 32  # less than a sector of a disk, which is written as a whole or not at all

_log = structlog.get_logger()


def main(lifeline_fd: int, membership: Path) -> None:
    found = load_membership(membership)
    if found is None:
        raise FileNotFoundError(f"{membership} is missing")
    asyncio.run(LeaseProcess.open(found, lifeline_fd, Path.cwd() / EPOCH).run())


class LeaseProcess:
    """Runs the lease; `epoch_file` has the greatest epoch of earlier runs.

    `peers` sends to the other appliance and receives from it, `asking` asks the witness.
    """

    def __init__(
        self,
        membership: Membership,
        supervisor: Channel,
        epoch_file: Path,
        *,
        peers: socket.socket,
        asking: socket.socket,
    ) -> None:
        self._membership = membership
        self._epoch_file = epoch_file
        self._stored = stored_epoch(epoch_file)
        session = secrets.token_hex(16)
        own, other = membership.name, membership.other
        self._lease = ApplianceLease(own, other, session, self._stored, clock.since_boot())
        self._witness = WitnessChannel(own, bytes.fromhex(membership.witness_key), session)
        self._peer = PeerChannel(own, other, bytes.fromhex(membership.peer_key))
        self.supervisor = supervisor
        self.child = Child(
            self.supervisor,
            lease_link.LeaseLink,
            said=self.control_said,
            linked=self.control_linked,
            lost=lambda _reason: self.control_linked(),
        )
        self.peers = peers
        self.asking = asking
        self._report = lease_link.ReplicationReported(0, False, None)
        self._present = self._able = False
        self._service = ServiceWatch()
        self._permission = 0
        self._alone = False
        self._reported: messages.LeaseHeld | messages.LeaseEnded = messages.LeaseEnded()
        self._answered: float | None = None
        self._told: lease_link.LeaseState | None = None
        self._told_at = 0.0
        self._wake = asyncio.Event()

    @classmethod
    def open(cls, membership: Membership, lifeline_fd: int, epoch_file: Path) -> Self:
        """Return the process with its sockets open. Raise `OSError` or `ValueError` if the epoch cannot be read."""
        stored_epoch(epoch_file)  # before a socket is open
        lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        peers = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # The kernel chooses this port, so that no other host can fill the buffer with forged answers.
        asking = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        return cls(membership, lifeline, epoch_file, peers=peers, asking=asking)

    async def run(self) -> None:
        """Raise `OSError` if the epoch cannot be stored: the appliance is then passive."""
        self.peers.bind(("0.0.0.0", self._membership.port))  # noqa: S104  the firewall admits the other appliance
        loop = asyncio.get_running_loop()
        for one, received in ((self.peers, self.peer_sent), (self.asking, self.witness_sent)):
            one.setblocking(False)
            loop.add_reader(one, self._readable, one, received)
        self.child.attach(messages.Ready())
        while not self.child.ended.is_set():
            self.tick()
            now = clock.since_boot()
            delay = max(0.005, min(self._lease.next_event(now) - now, _CONTROL_SECONDS))
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(delay):
                    await self._wake.wait()
        for one in (self.peers, self.asking):
            loop.remove_reader(one)
            one.close()

    # --- the lease ---

    def tick(self) -> None:
        lease, report, now = self._lease, self._report, clock.since_boot()
        current = report.permission == self._permission
        waiting = report.waiting_since
        if lease.answers_alone:
            # Control waits for the standby again, but the standby is away again: no removal follows, so permit again.
            overdue = current and waiting is not None and now - waiting > SILENCE
            if overdue or not self._alone:
                self._permission += 1
                current = False
        self._alone = lease.answers_alone
        lease.ready, lease.able = self._present, self._able
        self._give_away(now)
        caught_up = current and report.caught_up
        self._after(lease.tick(now, waiting_since=waiting, caught_up=caught_up))

    def _give_away(self, now: float) -> None:
        fault = self._service.fault(now, active=self._lease.is_active(now), present=self._present)
        if not fault:
            self._lease.fault = ""
            return
        kept = self._service.kept_for(now)
        try:
            if kept:
                raise LeaseError(
                    f"it gave the lease away before, and does so again in {kept:.0f} s at the earliest"
                )
            due = self._lease.switch_over(now)
        except LeaseError as error:
            if not self._lease.fault:
                _log.error(
                    "this appliance does not serve, and keeps the lease", reason=fault, kept=str(error)
                )
            self._lease.fault = f"{fault}; it keeps the lease: {error}"
            return
        self._lease.fault = ""
        self._service.given_away(now)
        _log.error("the lease is given to the other appliance, because this one does not serve", reason=fault)
        self._after(due)

    def _after(self, due: Outgoing) -> None:
        epoch = self._lease.epoch
        if epoch != self._stored:
            store_epoch(self._epoch_file, epoch)
            self._stored = epoch
        for message in due:
            to = self._membership
            if isinstance(message, WitnessRequest):
                self.send(self.asking, self._witness.write(message), (to.witness, to.witness_port))
            else:
                self.send(self.peers, self._peer.write(message), (to.other_address, to.port))
        self._tell_supervisor()
        self._tell_control()

    def send(self, sender: socket.socket, datagram: bytes, to: tuple[str, int]) -> None:
        with contextlib.suppress(OSError):  # no route at present; the lease asks again
            sender.sendto(datagram, to)

    def _readable(self, receiver: socket.socket, received: Callable[[bytes, str], None]) -> None:
        for _ in range(_BATCH):
            try:
                datagram, (address, _port) = receiver.recvfrom(_LARGEST)
            except BlockingIOError:
                break
            except OSError:
                continue  # an earlier datagram was not delivered
            received(datagram, address)
        self._wake.set()

    def witness_sent(self, datagram: bytes, address: str) -> None:
        found = self._witness.read(datagram) if address == self._membership.witness else None
        if found is not None:
            self._answered = clock.since_boot()
            self._after(self._lease.answered(*found))

    def peer_sent(self, datagram: bytes, address: str) -> None:
        if address == self._membership.other_address:
            message = self._peer.read(datagram)
            if message is not None:
                self._after(self._lease.received(clock.since_boot(), message))

    # --- supervisor and control ---

    def _tell_supervisor(self) -> None:
        lease, now = self._lease, clock.since_boot()
        report: messages.LeaseHeld | messages.LeaseEnded
        if lease.held is not None and lease.is_active(now):
            report = messages.LeaseHeld(lease.valid_until, lease.held)
        else:
            report = messages.LeaseEnded(renewable=lease.may_be_renewed(now))
        if report != self._reported:
            self._reported = report
            self.supervisor.send(report)

    def _tell_control(self) -> None:
        lease, now = self._lease, clock.since_boot()
        active = lease.is_active(now)
        seen = lease.seen
        standby = self._membership.name if lease.held is None else self._membership.other
        state = lease_link.LeaseState(
            until=lease.valid_until if active else 0.0,
            epoch=lease.epoch,
            sole=lease.sole,
            expired_since=lease.expired_since,
            alone=active and self._alone and lease.answers_alone,  # not after the order to add the standby
            permission=self._permission,
            in_sync=seen is not None and standby in seen.in_sync,
            holder=seen.holder if seen is not None else "",
            refusal=lease.refusal,
            answered=self._answered,
            heard=lease.heard,
            other_witnessed=lease.other_witnessed,
            takeover_obstacle=lease.takeover_obstacle(now),
            trouble=seen.trouble if seen is not None else "",
            follower_trouble=seen.follower_trouble if seen is not None else "",
            fault=lease.active_fault(now),
        )
        if state != self._told or now - self._told_at >= _CONTROL_SECONDS:
            self._told, self._told_at = state, now
            self.child.tell(state)

    def control_linked(self) -> None:
        """Make a new control wait for the standby until it gets a new permission."""
        self._present = False
        self._service.linked()
        self._report = lease_link.ReplicationReported(self._permission, False, None)
        self._told = None
        self._wake.set()

    def control_said(self, message: object) -> None:
        match message:
            case lease_link.ReplicationReported():
                self._report = message
            case lease_link.EpochSeen(epoch) if epoch <= HIGHEST:
                self._lease.follow(epoch)
            case lease_link.ControlPresent(able):
                self._present, self._able = True, able
            case lease_link.ControlUnready():
                self._present = False
            case lease_link.ControlServes(obstacle, keeps_state):
                self._service.reported(clock.since_boot(), obstacle, keeps_state=keeps_state)
            case lease_link.HandOverWanted():
                self._hand_over()
            case _:
                _log.error("control sent a message that is not for the lease", message=type(message).__name__)
        self._wake.set()

    def _hand_over(self) -> None:
        reason = ""
        try:
            due = self._lease.switch_over(clock.since_boot())
        except LeaseError as error:
            reason, due = str(error), ()
        self.child.tell(lease_link.HandOverAnswered(reason))
        self._after(due)


def stored_epoch(path: Path) -> int:
    """Return the stored epoch, or 0 for a new appliance. Raise `ValueError` if the file is damaged."""
    try:
        text = path.read_text("ascii").strip()
    except FileNotFoundError:
        return 0
    if not text.isdecimal() or int(text) > HIGHEST:
        raise ValueError(f"{path} does not contain an epoch: rosrv standby repair")
    return int(text)


def store_epoch(path: Path, epoch: int) -> None:
    """Overwrite the file if it exists, which needs no free space."""
    content = f"{epoch:<{_EPOCH_BYTES - 1}}\n".encode()
    if path.exists() and path.stat().st_size == _EPOCH_BYTES:
        write_synced(str(path), content)
    else:
        write_whole(path, content, 0o600)
