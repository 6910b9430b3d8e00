"""Define the records of takeovers between two appliances, and read them from a log.

A record names the other chain's last replicated checkpoint, and the takeover before it. So a removed record is
noticed, although epochs may have gaps.
"""

import sqlite3
from bisect import bisect_left, bisect_right
from itertools import islice
from typing import Annotated, Literal, NamedTuple

import msgspec

from appliance.audit.log.log_queries import decision_between, first_of, record_hash, records_of
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.copies import SignedCheckpoint

TOOK_OVER, HANDED_OVER, STAYED = "took over", "handed over", "switchover failed"
CLOCK_EVENTS = ("clock set back", "clock set forward")
_Epoch = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z][a-z0-9-]{0,31}\Z")]
_NOT_AS_WRITTEN = (ValueError, RecursionError, MemoryError)


class EpochOf(msgspec.Struct, frozen=True):
    """An epoch, and the appliance that took over in it."""

    epoch: _Epoch
    appliance: _Name


class TookOver(msgspec.Struct, frozen=True, kw_only=True):
    """The detail of a `took over` record; `checkpoint` is the last replicated one of the `other` appliance's log."""

    epoch: _Epoch
    appliance: _Name
    other: _Name
    checkpoint: SignedCheckpoint | None
    previous: EpochOf | None


class HandedOver(msgspec.Struct, frozen=True, kw_only=True):
    """The detail of a `handed over` record: `appliance` answered for the last time in this epoch."""

    epoch: _Epoch
    appliance: _Name
    to: _Name


class Takeover(NamedTuple):
    """A takeover; times are nanoseconds since the epoch, by the appliance's own clock."""

    sequence: int
    time: int
    detail: TookOver


class Handover(NamedTuple):
    """A hand-over with its place and time."""

    sequence: int
    time: int
    detail: HandedOver


class DecisionPlace(NamedTuple):
    """The place and time of a decision."""

    sequence: int
    time: int


class TakeoverLog:
    """The verified part of one log, read from one snapshot. Methods raise `sqlite3.DatabaseError`."""

    def __init__(self, connection: sqlite3.Connection, result: Verification) -> None:
        self._connection = connection
        self.result = result
        self.takeovers: list[Takeover] = []
        self.handovers: list[Handover] = []
        self.unreadable: list[int] = []
        """The sequences of records whose detail is not a valid takeover or hand-over."""
        self._read()
        self.names = {takeover.detail.appliance for takeover in self.takeovers}
        self.epochs = {takeover.detail.epoch for takeover in self.takeovers}
        self.first_epoch = min(self.epochs, default=None)
        self._places = [takeover.sequence for takeover in self.takeovers]

    def _read(self) -> None:
        rows = records_of(self._connection, TOOK_OVER, HANDED_OVER, upto=self.result.last)
        for sequence, time, event, detail in rows:
            _require_integers(sequence, time)
            try:
                if event == TOOK_OVER:
                    decoded = msgspec.json.decode(detail, type=TookOver)
                    self.takeovers.append(Takeover(sequence, time, decoded))
                else:
                    handed = msgspec.json.decode(detail, type=HandedOver)
                    self.handovers.append(Handover(sequence, time, handed))
            except _NOT_AS_WRITTEN:
                self.unreadable.append(sequence)

    def before(self, sequence: int) -> Takeover | None:
        place = bisect_left(self._places, sequence)
        return self.takeovers[place - 1] if place else None

    def end_of(self, sequence: int, epoch: int = -1) -> int:
        later = islice(self.takeovers, bisect_right(self._places, sequence), None)
        return next((one.sequence - 1 for one in later if one.detail.epoch > epoch), self.result.last)

    def last_decision(self, after: int, through: int) -> DecisionPlace | None:
        return self._decision(after, through, "last")

    def first_decision(self, after: int, through: int) -> DecisionPlace | None:
        return self._decision(after, through, "first")

    def _decision(self, after: int, through: int, end: Literal["first", "last"]) -> DecisionPlace | None:
        row = decision_between(self._connection, after, through, end)
        if row is None:
            return None
        _require_integers(*row)
        return DecisionPlace(*row)

    def clock_was_set(self, after: int, through: int) -> bool:
        return any(self._first(event, after, through) for event in CLOCK_EVENTS)

    def stayed(self, after: int, through: int) -> int | None:
        return self._first(STAYED, after, through)

    def _first(self, event: str, after: int, through: int) -> int | None:
        place = first_of(self._connection, event, after, through)
        if place is not None:
            _require_integers(place)
        return place

    def hash_at(self, sequence: int) -> bytes | None:
        digest = record_hash(self._connection, sequence)
        return digest if isinstance(digest, bytes) else None

    def checkpoint_text(self, number: int) -> bytes:
        row = self._connection.execute("SELECT text FROM checkpoint WHERE number = ?", (number,)).fetchone()
        return b"" if row is None else row[0]


def _require_integers(*values: object) -> None:
    if not all(isinstance(value, int) for value in values):
        raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
