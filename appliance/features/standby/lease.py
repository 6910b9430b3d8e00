"""The lease as an appliance sees it: active or passive, by times and messages alone, without clock and socket.

All times are from the appliance's own clock, which must run while the machine sleeps (CLOCK_BOOTTIME); clocks are
never compared.

1. An appliance is active in its epoch for 0.8 of an expiry after it *sent* a renewal that was granted, or a request for
   a promise that was given. The witness and the other appliance count a whole expiry from a later time. Both also end
   a lapse: an appliance that knows a later epoch promises nothing, and is active in its own only after its promise.
2. Only a grant of the witness begins an epoch, and no appliance is active before its promise not to claim has ended.
3. A passive appliance gives no promise while the witness says that the lease has expired: the active appliance is cut
   off from the robot, which then needs this one. So it asks the witness even during a promise.
4. An appliance that starts may have given a promise before, so it claims one expiry later.
5. Only the witness makes epochs. An active appliance believes no later epoch: by 1 and 2 there is none. A passive
   appliance believes it until the witness answers, unless the epoch is beyond `FARTHEST`.
6. The active appliance answers without the standby only after the witness has removed the standby from the in-sync
   set. It waits for the standby again before it asks the witness to add it.
7. The active appliance also gives up if the witness answers only the other one for an expiry: otherwise a promise of
   the other one would delay its claim.
8. The active appliance gives its lease up only if the other one, by its promises, could claim it at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from appliance.features.standby.witness.protocol import EXPIRY, HIGHEST

RENEW_SECONDS = 0.3
CLAIM_SECONDS = 0.1  # between two claims, while no appliance is admitted
CONFIDENCE = 0.8 * EXPIRY  # the rest allows for clocks that run at different speeds
SILENCE = EXPIRY / 2  # after which the standby is removed if an answer waits for it
FARTHEST = 1 << 20  # takeovers and restarts that an appliance may have missed
_RENEWABLE = 2 * EXPIRY  # in this time after its lease has lapsed, the other appliance has claimed, or cannot
_MAX_PENDING = 16
_MAX_TOLD = 400  # characters of a fault in a datagram

Operation = Literal["renew", "claim", "remove", "add", "release", "look"]


class LeaseError(Exception):
    """An order is not possible now; the message has the remedy."""


@dataclass(frozen=True)
class WitnessRequest:
    """A request to the witness; `sequence` orders the requests of this process."""

    operation: Operation
    epoch: int
    sequence: int
    sent: float


class WitnessAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """The lease after a request, as the witness sends it."""

    ok: bool = False
    reason: str = ""
    epoch: Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)] = 0
    holder: str = ""
    in_sync: frozenset[str] = frozenset()
    expired: bool = False
    """Whether no appliance has renewed the lease in time."""
    trouble: str = ""
    follower_trouble: str = msgspec.field(default="", name="followers")


@dataclass(frozen=True)
class PromiseRequest:
    """A request to promise not to claim the lease for one expiry."""

    epoch: int
    session: str
    number: int
    fault: str = ""
    """Why the sender does not serve, and keeps the lease."""


@dataclass(frozen=True)
class ClaimPromise:
    """The answer to a `PromiseRequest`, which it repeats."""

    epoch: int
    session: str
    number: int
    able: bool = True
    unheard: float = 0.0
    """The seconds since the sender's last request that the witness answered."""


@dataclass(frozen=True)
class TakeOver:
    """The order to claim the lease now. It ends the promises with this number or a lower one."""

    epoch: int
    session: str
    number: int


PeerMessage = PromiseRequest | ClaimPromise | TakeOver
Outgoing = Sequence[WitnessRequest | PeerMessage]


class ApplianceLease:
    """The state of one appliance, whose owner calls `tick` when `next_event` is due.

    `epoch` is the highest that it has stored.
    """

    def __init__(self, name: str, other: str, session: str, epoch: int, now: float) -> None:
        self.epoch = epoch
        self.held: int | None = None
        self.answers_alone = False
        self.refusal = ""  # why the witness grants this appliance nothing until an operator acts
        self.seen: WitnessAnswer | None = None  # the last answer that knew it
        self.ready = True  # False: this appliance could not serve, so it does not claim
        self.able = True  # False: it claims only what the other one has lost
        self.fault = ""  # why this appliance does not serve, and keeps the lease
        self._other_fault = ""
        self._name = name
        self._other = other
        self._session = session
        self._valid_until = now
        self._promised_until = now + EXPIRY
        self._promised_to: PromiseRequest | None = None
        self._next_round = now
        self._sequence = 0
        self._asked: dict[int, float] = {}
        self._number = 0
        self._started = self._heard = now - EXPIRY
        self._witnessed_at = self._started  # sending time of the last request that the witness answered
        self._trouble = ""
        self._other_able = True
        self._other_witnessed: float | None = None
        self._next_removal = now
        self._expired = False
        self.sole = False  # whether the witness's in-sync set names only this appliance
        self.expired_since: float | None = None  # according to the witness, without a silence of one expiry
        self._told_expiry = now
        self._last_add = 0
        self._witnessed = epoch  # the greatest epoch of the witness
        self._rumoured = (
            0  # requests up to this number were sent before the other appliance claimed the epoch
        )
        # A switchover: requests and promises up to these numbers no longer make this appliance active.
        self._switching_until: float | None = None
        self._released = False
        self._void_sequence = self._void_number = 0

    @property
    def valid_until(self) -> float:
        return self._valid_until

    @property
    def heard(self) -> float | None:
        return self._heard if self._heard > self._started else None

    @property
    def other_witnessed(self) -> float | None:
        return self._other_witnessed

    def takeover_obstacle(self, now: float) -> str:
        """Return why the appliance that is not active could not claim the lease now."""
        if self.is_active(now):
            return self.handover_obstacle(now)
        if self.refusal:
            return self._refused()
        if self.seen is None or now - self._witnessed_at > EXPIRY:
            return (
                "the witness on the robot does not answer this appliance; check the network between the two"
            )
        if self._name not in self.seen.in_sync:
            return f"{self._name} lacks changes that {self._other} has acknowledged; wait until it has them"
        return self._refused()

    def handover_obstacle(self, now: float) -> str:
        other = self._other
        if self.refusal or self._trouble:
            return self._refused()
        if self.answers_alone or now - self._heard > SILENCE:
            return f"{other} is not ready to take over; wait until it answers and has all data"
        if not self._other_able:
            return f"{other} could not serve after a takeover; `rosrv standby status` there says why"
        if self._other_witnessed is None or now - self._other_witnessed > EXPIRY:
            return f"the witness on the robot does not answer {other}; check the network between {other} and the robot"
        return ""

    def _refused(self) -> str:
        if self.refusal:
            return f"the witness on the robot refuses this appliance: {self.refusal}"
        return (
            f"the witness on the robot could not grant the takeover: {self._trouble}" if self._trouble else ""
        )

    def is_active(self, now: float) -> bool:
        return self.held is not None and self._promised_until <= now < self._valid_until

    def active_fault(self, now: float) -> str:
        """Return why the active appliance does not serve, and keeps the lease; empty if it is not known."""
        if self.is_active(now):
            return self.fault
        return self._other_fault if now < self._promised_until else ""

    def may_be_renewed(self, now: float) -> bool:
        """Return whether a lapsed lease may be renewed in its epoch: no other appliance can have been active since."""
        if self.held is None or self._switching_until is not None:
            return False
        return self.answers_alone or now < self._valid_until + _RENEWABLE

    def next_event(self, now: float) -> float:
        changes = (self._valid_until, self._promised_until)
        return min([self._next_round, *(time for time in changes if time > now)])

    def follow(self, epoch: int) -> bool:
        if epoch < self.epoch or epoch == self.held:
            return False
        if epoch - self.epoch > FARTHEST:
            return False
        if epoch > self.epoch:
            self._rumoured = self._sequence
        self._learn(epoch)
        return True

    def tick(self, now: float, *, waiting_since: float | None, caught_up: bool) -> Outgoing:
        """Return the due messages. `waiting_since` is the time of the oldest change that waits for the standby."""
        if now < self._next_round:
            return self._remove(now, waiting_since)
        if self.held is None:
            return (self._claim_or_look(now),)
        self._next_round = now + RENEW_SECONDS
        if self._switching_until is not None:
            if now < self._switching_until:
                expired = self._released or now - self._witnessed_at > EXPIRY
                return (self._take_over() if expired else self._to_witness("release", now),)
            self._switching_until = None  # the other appliance did not claim
        if self._is_cut_off(now):
            self._give_up(now, released=True)  # the lease has expired at the witness
            return ()
        due: list[WitnessRequest | PeerMessage] = [self._to_witness("renew", now), self._ask(now)]
        if self.is_active(now):
            due += self._remove(now, waiting_since)
            if self.answers_alone and caught_up:
                self.answers_alone = False
                due.append(self._to_witness("add", now))
                self._last_add = self._sequence
        return due

    def _claim_or_look(self, now: float) -> WitnessRequest:
        """Return the request of an appliance that holds no epoch: a claim if it may be active, and has not promised."""
        if now < self._promised_until:
            self._next_round = min(now + RENEW_SECONDS, self._promised_until)
            return self._to_witness("look", now)
        self._next_round = now + (CLAIM_SECONDS if self.ready else RENEW_SECONDS)
        return self._to_witness("claim" if self.ready else "look", now)

    def answered(self, request: WitnessRequest, answer: WitnessAnswer) -> Outgoing:
        self.refusal, self._trouble = "", answer.trouble
        if self.epoch and answer.epoch - self.epoch > FARTHEST:
            self.refusal = (
                f"the witness has epoch {answer.epoch}, this appliance {self.epoch}: if an operator chose that of the"
                " witness, stop this appliance and run `rosrv standby repair`"
            )
            return ()
        if answer.epoch < self.epoch and request.sequence > self._rumoured:
            self.epoch = max(
                answer.epoch, self._witnessed
            )  # what the other appliance claimed was never granted
        if not answer.epoch or answer.epoch < min(request.epoch, self._witnessed):
            self.refusal = answer.reason
        else:
            self._witnessed_at = max(self._witnessed_at, request.sent)
        if answer.epoch < self.epoch:
            return ()
        self._witnessed, self.seen = answer.epoch, answer
        self._expired = answer.expired
        self.sole = answer.in_sync == {self._name}
        self._note_expiry(request.sent, expired=answer.expired)
        if answer.holder != self._name or not answer.ok:
            self._learn(
                answer.epoch
            )  # perhaps of a grant to this appliance whose answer was lost: it claims again
            return ()
        if request.operation == "claim" and answer.epoch > request.epoch:
            self.held = self.epoch = answer.epoch
            self._switching_until = None
        if self.held != answer.epoch:
            return ()
        if request.sequence > self._last_add:
            self.answers_alone = self._other not in answer.in_sync
        if request.operation in ("claim", "renew") and request.sequence > self._void_sequence:
            self._valid_until = max(self._valid_until, request.sent + CONFIDENCE)
        if request.operation == "release" and self._switching_until is not None:
            self._released = True
        return ()

    def _note_expiry(self, now: float, *, expired: bool) -> None:
        if not expired:
            self.expired_since = None
        elif self.expired_since is None or now - self._told_expiry > EXPIRY:
            self.expired_since = now
        self._told_expiry = now

    def received(self, now: float, message: PeerMessage) -> Outgoing:
        match message:
            case PromiseRequest():
                if self.is_active(now):
                    return ()
                if not self.follow(message.epoch) or self._expired:
                    return ()
                self._promised_until = max(self._promised_until, now + EXPIRY)
                last = self._promised_to
                if last is None or (message.epoch, message.number) > (last.epoch, last.number):
                    self._promised_to = (
                        message  # an earlier request that arrives late is not the last promise
                    )
                self._other_fault = message.fault
                able = self.ready and self.able and not (self.refusal or self._trouble)
                unheard = now - self._witnessed_at
                return (ClaimPromise(message.epoch, message.session, message.number, able, unheard),)
            case ClaimPromise(epoch, session, number):
                asked = self._asked.get(number)
                if session == self._session and epoch == self.held and asked is not None:
                    if asked >= self._heard:
                        self._other_able, self._other_witnessed = message.able, asked - message.unheard
                    self._heard = max(self._heard, asked)
                    if number > self._void_number:
                        self._valid_until = max(self._valid_until, asked + CONFIDENCE)
            case TakeOver(epoch, session, number):
                promised = self._promised_to
                if (
                    promised is not None
                    and (promised.epoch, promised.session) == (epoch, session)
                    and promised.number <= number
                    and epoch == self.epoch
                ):
                    self._promised_until = now
                    self._promised_to = None
                    return (self._claim_or_look(now),)
        return ()

    def switch_over(self, now: float) -> Outgoing:
        if not self.is_active(now):
            raise LeaseError("this appliance is not active; give the order to the other one")
        obstacle = self.handover_obstacle(now)
        if obstacle:
            raise LeaseError(obstacle)
        self._give_up(now, released=False)
        return (self._to_witness("release", now),)

    def _give_up(self, now: float, *, released: bool) -> None:
        """Become passive. The other appliance hears of it a round later, after the processes of this one.

        With `released`, the witness need not be asked first.
        """
        self._valid_until = now
        self._next_round = now + CLAIM_SECONDS
        self._void_sequence, self._void_number = self._sequence, self._number
        self._switching_until, self._released = now + 2 * EXPIRY, released

    def _is_cut_off(self, now: float) -> bool:
        """Return whether only the other appliance reaches the robot. A witness that has ended answers neither."""
        other = self._other_witnessed
        return (
            self.is_active(now)
            and now - self._witnessed_at > EXPIRY
            and other is not None
            and other - self._witnessed_at > SILENCE
            and not self.handover_obstacle(now)
        )

    def _learn(self, epoch: int) -> None:
        if epoch > self.epoch:
            self.epoch = epoch
            self.held = None

    def _remove(self, now: float, waiting_since: float | None) -> Sequence[WitnessRequest]:
        waits = waiting_since is not None and now - waiting_since > SILENCE
        if not waits or self.answers_alone or now < self._next_removal or not self.is_active(now):
            return ()
        self._next_removal = now + RENEW_SECONDS
        return (self._to_witness("remove", now),)

    def _to_witness(self, operation: Operation, now: float) -> WitnessRequest:
        self._sequence += 1
        epoch = self.epoch if self.held is None else self.held
        return WitnessRequest(operation, epoch, self._sequence, now)

    def _ask(self, now: float) -> PromiseRequest:
        self._number += 1
        self._asked[self._number] = now
        self._asked.pop(self._number - _MAX_PENDING, None)
        return PromiseRequest(self.epoch, self._session, self._number, _in_datagram(self.fault))

    def _take_over(self) -> TakeOver:
        return TakeOver(self.epoch, self._session, self._void_number)


def _in_datagram(fault: str) -> str:
    """Return a fault without the middle of a long one: its beginning says what is wrong, its end what is done."""
    text = fault.encode("ascii", "replace").decode("ascii")
    half = _MAX_TOLD // 2
    return text if len(text) <= _MAX_TOLD else f"{text[:half]}...{text[-half:]}"
