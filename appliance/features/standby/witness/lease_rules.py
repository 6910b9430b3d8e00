"""The rules by which the witness grants the lease. No I/O."""

from typing import Callable, Optional, Set

from appliance.features.standby.witness.errors import UncertainError, WitnessError
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.protocol import EXPIRY


class Witness:
    """The rules of the lease.

    `admit` changes the firewall to admit one appliance, or none (""). It raises `UncertainError` if it may have
    changed something, and `WitnessError` if not; so does `save`. Without a `record`, every request is refused.

    """

    def __init__(
        self,
        *,
        record: Optional[LeaseRecord],
        save: Callable[[LeaseRecord], None],
        admit: Callable[[str], None],
        boot: str,
        clock: Callable[[], float],
    ) -> None:
        self.record = record
        self._save = save
        self._admit = admit
        self._boot = boot
        self._clock = clock
        self._expires = clock() + EXPIRY
        self.trouble = ""  # why the next takeover would fail
        self.unknown_rules = (
            ""  # why the rules cannot be listed, or those of the next takeover not be written
        )
        self.unsettled = False  # whether the disk may have another lease than `record`
        # Within one boot the rules of an earlier process stay, so that its end alone changes nothing.
        self.admitted = record.holder if record is not None and record.boot == boot else ""
        admit(self.admitted)

    def enforce_again(self) -> None:
        holder = self.record.holder if self.record is not None else ""
        self._enforce(holder if self.admitted == holder else "")

    def settle(self) -> None:
        """Save the lease again, so that the disk has this one."""
        if self.record is not None:
            self._save(self.record)
        self.unsettled = False

    def now(self) -> float:
        return self._clock()

    def left(self) -> float:
        return max(0.0, self._expires - self._clock())

    def handle(self, name: str, operation: str, epoch: int, other: str) -> str:
        if self.record is None:
            return "the lease is damaged: run witness.py begin on the robot"
        if epoch > self.record.epoch:
            return (
                "the witness knows only epoch %d: run witness.py begin with a greater epoch"
                % self.record.epoch
            )
        try:
            if operation in ("claim", "look"):
                return self._claim(self.record, name) if operation == "claim" else ""
            if (self.record.holder, self.record.epoch) != (name, epoch):
                return "%s holds epoch %d" % (self.record.holder or "no appliance", self.record.epoch)
            if operation == "renew":
                self._renew(self.record)
            elif operation == "release":
                self._expires = self._clock()
            else:
                self._change_in_sync(self.record, {name, other} if operation == "add" else {name})
        except WitnessError as error:
            return str(error)
        return ""

    def _claim(self, before: LeaseRecord, name: str) -> str:
        if self._clock() < self._expires:
            return "%s holds the lease for another %.1f s" % (before.holder or "no appliance", self.left())
        if name not in before.in_sync:
            return "%s is not in sync" % name
        if self.unknown_rules:
            return self.unknown_rules
        self._change(before._replace(epoch=before.epoch + 1, holder=name, boot=self._boot))
        try:
            self._enforce(name)
        except WitnessError:
            self._change(before)
            raise
        self._expires = self._clock() + EXPIRY
        return ""

    def _renew(self, record: LeaseRecord) -> None:
        if self.admitted != record.holder:
            self._change(record._replace(boot=self._boot))
            self._enforce(record.holder)
        self._expires = self._clock() + EXPIRY

    def _change_in_sync(self, record: LeaseRecord, wanted: Set[str]) -> None:
        if wanted != set(record.in_sync):
            self._change(record._replace(in_sync=tuple(sorted(wanted))))

    def _change(self, record: LeaseRecord) -> None:
        if self.unsettled:
            self.settle()
        try:
            self._save(record)
        except UncertainError:
            self.unsettled = True
            raise
        self.record = record

    def _enforce(self, name: str) -> None:
        before = self.admitted
        try:
            self._admit(name)
        except UncertainError:
            self.admitted = "?"  # after a second failure, the next renewal tries again
            self._admit(before if before != "?" else "")
            self.admitted = before
            raise
        self.admitted = name
