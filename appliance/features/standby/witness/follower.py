"""The rules by which another computer does as the witness does. No I/O."""

from typing import Any, Callable, Dict, Iterable, List, NamedTuple

from appliance.features.standby.witness.errors import UncertainError
from appliance.features.standby.witness.protocol import (
    ANSWER,
    EXPIRY,
    FLAP_SECONDS,
    LONGEST_REPORT,
    REQUEST,
    Left,
    is_count,
    name_in,
    seal,
    unseal,
)

LOOK_SECONDS = 0.2  # between two requests of a follower
_MAX_PENDING = 8
_CONFIDENCE = 0.9  # of the time that an answer has left
_FLAPS, _MAX_FLAPS = 3, 100  # interruptions that are reported; that are counted

Answered = NamedTuple("Answered", [("epoch", int), ("holder", str), ("until", float)])
"""The newest answer to a follower: it may admit `holder` (or no appliance, "") until a time of its clock."""


class WitnessFollower:
    """The rules of a follower.

    It admits an appliance only for 0.9 of the time that its lease has left, counted from the time the request was
    *sent*; the rest allows for clocks of different speeds. So while the robot admits one appliance, no follower
    begins to admit the other, unless the first has given the lease up: rules that are still being written when this
    time ends are abandoned. Without answers, both are shut out after at most one expiry.

    A slow disk or firewall delays no answer: `request` and `receive` belong to the thread that asks, `save_epoch` to
    one that saves, all others to the one that writes the rules. Each field is assigned by one of them.
    """

    def __init__(
        self,
        *,
        name: str,
        key: bytes,
        appliances: Iterable[str],
        session: str,
        epoch: int,  # the greatest saved; no smaller one, of a witness restored from an old disk, is accepted
        save: Callable[[int], None],
        admit: Callable[[str, Left], None],  # raises `UncertainError` if the time that is left ends
        clock: Callable[[], float],  # runs even while the computer sleeps
    ) -> None:
        self.epoch = epoch
        self.refusal = ""
        self.answered = clock()
        self.report = ""  # for the witness
        self._name = name
        self._key = key
        self._appliances = frozenset(appliances)
        self._session = session
        self._save = save
        self._admit = admit
        self._clock = clock
        self._boot = ""
        self._number = 0
        self._reporting = False
        self._pending = {}  # type: Dict[int, float]
        self._newest = self._used = Answered(0, "", 0.0)
        self._saved = epoch
        self._admitted = "?"  # unknown: an earlier process may have written rules
        self._opened = False
        self._epoch_admitted = 0
        self._interrupted = []  # type: List[float]
        self.tick()

    def request(self) -> bytes:
        self._number += 1
        self._pending[self._number] = self._clock()
        if len(self._pending) > _MAX_PENDING:
            del self._pending[min(self._pending)]
        body = {
            "boot": self._boot,
            "session": self._session,
            "number": self._number,
            "do": "look",
            "epoch": self.epoch,
        }
        if self._reporting:  # an earlier version of the witness rejects the field
            body["report"] = self.report
        return seal(REQUEST, self._name, self._key, body)

    def receive(self, datagram: bytes) -> None:
        body = unseal(ANSWER, self._key, datagram) if name_in(datagram) == self._name else None
        if body is None or body.get("session") != self._session or not is_count(body.get("number")):
            return
        sent = self._pending.get(body["number"])
        if sent is None:
            return
        self.answered = self._clock()
        # An answer that overtook earlier ones is newer: theirs no longer count.
        self._pending = {number: at for number, at in self._pending.items() if number > body["number"]}
        if body.get("stale") is True:
            if isinstance(body.get("boot"), str) and is_count(body.get("last")):
                self._boot, self._number = body["boot"], max(self._number, body["last"])
            return
        epoch, left, admitted = body.get("epoch"), body.get("left"), body.get("admitted")  # type: Any, Any, Any
        if not (is_count(epoch) and is_count(left) and isinstance(admitted, str)):
            return
        self._reporting = body.get("reports") is True
        self.refusal = ""
        if body.get("ok") is not True:
            self.refusal = str(body.get("reason"))[:200]
        elif epoch < self.epoch:
            self.refusal = "the witness has epoch %d, but had %d before" % (epoch, self.epoch)
        if self.refusal or (admitted and admitted not in self._appliances):
            return
        self.epoch = epoch
        self._newest = Answered(epoch, admitted, sent + _CONFIDENCE * min(left / 1000.0, EXPIRY))

    def save_epoch(self) -> bool:
        """Save a new epoch, and return whether there was one. Until then no answer with it admits an appliance."""
        epoch = self._newest.epoch
        if epoch <= self._saved:
            return False
        self._save(epoch)
        self._saved = epoch
        return True

    def tick(self) -> None:
        wanted = self._wanted()
        if wanted == self._admitted:
            return
        try:
            self.enforce(wanted)
        except UncertainError:
            if self._wanted() == wanted:
                raise
            self.enforce("")  # the lease ended, so the writing was abandoned

    def enforce_again(self) -> None:
        self.enforce(self._wanted())

    def enforce(self, name: str) -> None:
        """Write the rules; after a `WitnessError`, the next `tick` tries again."""
        if self._opened and not name:
            self._interrupted = [*self._interrupted[1 - _MAX_FLAPS :], self._clock()]
        elif name:
            if not self._opened and self._used.epoch > self._epoch_admitted and self._interrupted:
                self._interrupted.pop()  # the pause of a takeover
            self._epoch_admitted = self._used.epoch
        self._admitted, self._opened = "?", bool(name)
        self._admit(name, lambda: self._seconds_left(name))
        self._admitted = name

    def pause(self) -> float:
        """Return the seconds until the next `tick` is due, if no answer comes."""
        now, wanted = self._clock(), self._wanted()
        if self._admitted not in (wanted, "?"):
            return 0.0
        return min(LOOK_SECONDS, self._used.until - now) if wanted else LOOK_SECONDS

    def note(self, trouble: str) -> None:
        """Report a trouble of this computer, or that topics are interrupted again and again."""
        now = self._clock()
        interrupted = sum(now - at < FLAP_SECONDS for at in self._interrupted)
        if not trouble and interrupted >= _FLAPS:
            trouble = "it shut out both appliances %d times in a minute" % interrupted
        self.report = trouble[:LONGEST_REPORT]

    def _wanted(self) -> str:
        newest = self._newest
        if newest.epoch <= self._saved:
            self._used = newest
        return self._used.holder if self._clock() < self._used.until else ""

    def _seconds_left(self, name: str) -> float:
        """Return the seconds that rules may still need until they are in force."""
        if not name:
            return EXPIRY  # to shut out is always right
        return self._used.until - self._clock() if self._wanted() == name else 0.0
