"""Define the records of takeovers between two appliances, and read them from a log.

A record names the other chain's last replicated checkpoint, and the takeover before it. So a removed record is
noticed, although epochs may have gaps.
"""

import sqlite3
from bisect import bisect_left, bisect_right
from itertools import islice
from typing import Annotated, NamedTuple

import msgspec

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
        rows = self._connection.execute(
            "SELECT sequence, time, event, CAST(detail AS BLOB) FROM record WHERE event IN (?, ?) AND sequence <= ?"
            " ORDER BY sequence",
            (TOOK_OVER, HANDED_OVER, self.result.last),
        )
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
        return self._decision("DESC", after, through)

    def first_decision(self, after: int, through: int) -> DecisionPlace | None:
        return self._decision("ASC", after, through)

    def _decision(self, order: str, after: int, through: int) -> DecisionPlace | None:
        # Retention writes old denials again, with their old time and `kept`; a quote inside a string is escaped.
        row = self._connection.execute(
            "SELECT sequence, time FROM record WHERE +event = 'decision' AND sequence > ? AND sequence <= ?"  # noqa: S608  a fixed word
            f""" AND instr(CAST(detail AS TEXT), '"kept":') = 0 ORDER BY sequence {order} LIMIT 1""",
            (after, through),
        ).fetchone()
        if row is None:
            return None
        _require_integers(*row)
        return DecisionPlace(*row)

    def clock_was_set(self, after: int, through: int) -> bool:
        return any(self._first(event, after, through) for event in CLOCK_EVENTS)

    def stayed(self, after: int, through: int) -> int | None:
        return self._first(STAYED, after, through)

    def _first(self, event: str, after: int, through: int) -> int | None:
        query = "SELECT min(sequence) FROM record WHERE event = ? AND sequence > ? AND sequence <= ?"
        (place,) = self._connection.execute(query, (event, after, through)).fetchone()
        if place is not None:
            _require_integers(place)
        return place  # type: ignore[no-any-return]  # checked above

    def hash_at(self, sequence: int) -> bytes | None:
        row = self._connection.execute("SELECT hash FROM record WHERE sequence = ?", (sequence,)).fetchone()
        return row[0] if row is not None and isinstance(row[0], bytes) else None

    def checkpoint_text(self, number: int) -> bytes:
        row = self._connection.execute("SELECT text FROM checkpoint WHERE number = ?", (number,)).fetchone()
        return b"" if row is None else row[0]


def _require_integers(*values: object) -> None:
    if not all(isinstance(value, int) for value in values):
        raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
