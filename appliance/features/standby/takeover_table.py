"""Print the verification of two logs and of the takeovers between them."""

import enum
import sqlite3
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import groupby, islice, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import msgspec

from appliance.audit.log.log_database import reading
from appliance.audit.log.log_queries import EventRow, outer_decisions, record_hash, records_of
from appliance.audit.log.record_format import printable
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.copies import KnownLog
from appliance.base.timestamps import local_text
from appliance.cli.audit.audit_errors import fail
from appliance.cli.audit.verification_text import print_verification, write
from appliance.features.standby.membership import MembershipError, load_membership, path_of
from appliance.features.standby.takeovers import TOOK_OVER, HandedOver, TookOver
from appliance.signing.log_proof import ProofFault

# Verify the takeovers between the verified logs of two appliances.
#
# 1. The checkpoint that a takeover names is in the other log, with this hash and a signature by the other log's
#    key.
# 2. Epochs increase in each log and over both. No record up to a named checkpoint is of a later epoch.
# 3. The earlier takeover that a takeover names is in its log.
# 4. An appliance decides nothing between its hand-over and its next takeover, except what was under way.
# 5. While one appliance decided, the other was silent for at least as long. Each duration is measured with one
#    clock. `_TOLERANCE` allows for a clock that was set while its machine was off.

_SECOND = 1_000_000_000
_TOLERANCE = 5 * _SECOND
_DRIFT = 5_000  # clocks may differ by one part in this number
_MAX_FINDINGS = 1000
_DECISION, _HANDED_OVER, _STAYED = "decision", "handed over", "switchover failed"
_CLOCK_SET = ("clock set back", "clock set forward")
_EVENTS = (TOOK_OVER, _HANDED_OVER, _STAYED, *_CLOCK_SET)
_SEQUENCE = attrgetter("sequence")
_T = TypeVar("_T")
Link = Literal["proven", "removed", "none", "wrong"]
Overlap = Literal["excluded", "found", "unknown"]


class TakeoverFindingKind(enum.StrEnum):
    """The kind of a finding between two logs."""

    SAME_LOG = "same log"
    LOG_MISSING = "log missing"
    UNREADABLE = "takeover unreadable"
    TAKEOVER_MISSING = "takeover missing"
    EPOCH_ORDER = "epoch out of order"
    WRONG_NAME = "wrong name"
    LOG_REPLACED = "log replaced"
    TRUNCATED = "truncated"
    REWRITTEN = "rewritten"
    CHECKPOINT_CHANGED = "checkpoint changed"
    SIGNATURE_WRONG = "signature wrong"
    WRONG_KEY = "wrong key"
    OVERLAP = "epochs overlap"


class TakeoverFinding(msgspec.Struct, frozen=True):
    """A fault between two logs; `epoch` is 0 if the finding is not about one takeover."""

    kind: TakeoverFindingKind
    epoch: int
    message: str


class TakeoverProof(msgspec.Struct, frozen=True, kw_only=True):
    """A takeover with its proof; `sequence` is its record in the log of `appliance`."""

    epoch: int
    appliance: str
    other: str
    log: str
    sequence: int
    time: int
    link: Link
    """"proven": the named checkpoint is in the other log; "removed": retention removed its records since; "none": no
    checkpoint was replicated.
    """
    through: int
    """The last record of the other log that the named checkpoint sealed."""
    tail: int
    """The number of the other log's later records, until its next takeover."""
    tail_signed: int
    """The number of these records that later checkpoints seal."""
    overlap: Overlap


class PairVerification(msgspec.Struct, frozen=True, kw_only=True):
    """The verification of two logs; `absent` is an appliance without a log: it was never active."""

    ok: bool
    logs: tuple[Verification, ...]
    takeovers: list[TakeoverProof]
    findings: list[TakeoverFinding]
    absent: str = ""


class VerifiedLog(NamedTuple):
    """A log's file, and the result of its verification."""

    path: Path
    result: Verification


def verify_takeovers(*logs: VerifiedLog, absent: str = "") -> PairVerification:
    """Verify two logs; or one, which may not name the log that the appliance `absent` does not have."""
    findings: list[TakeoverFinding] = []
    proofs: list[TakeoverProof] = []
    with ExitStack() as stack:
        connections = [stack.enter_context(reading(log.path, advice="")) for log in logs]
        try:
            told = [_Log(connection, log.result) for connection, log in zip(connections, logs, strict=True)]
            if absent:
                findings += told[0].names_of(absent)
            else:
                _Walk(findings, proofs).along(*told)
        except sqlite3.DatabaseError as error:
            message = f"the records of takeovers cannot be read: {error}"
            findings.append(TakeoverFinding(TakeoverFindingKind.UNREADABLE, 0, message))
    results = tuple(log.result for log in logs)
    return PairVerification(
        ok=not findings and all(result.ok for result in results), logs=results, takeovers=proofs,
        findings=findings[:_MAX_FINDINGS], absent=absent,
    )  # fmt: skip


class _Takeover(NamedTuple):
    log: "_Log"
    sequence: int
    time: int
    detail: TookOver

    @property
    def epoch(self) -> int:
        return self.detail.epoch


class _Log:
    """The part of a verified log that the proof reads: `_EVENTS`, and the outer decisions between two of them."""

    other: "_Log"

    def __init__(self, connection: sqlite3.Connection, result: Verification) -> None:
        connection.execute("BEGIN")
        self._connection, self.result = connection, result
        first, key = result.removed + 1, result.key or "no key"
        self.known = KnownLog(result.log, key, first, result.last, self._hash, self._checkpoint)
        self._rows: list[EventRow] = []
        after = 0
        for row in records_of(connection, *_EVENTS, upto=result.last):
            self._rows += [*outer_decisions(connection, after, row.sequence), row]
            after = row.sequence
        self._rows += outer_decisions(connection, after, result.last)
        if not all(isinstance(value, int) for row in self._rows for value in row[:2]):
            raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
        self.unreadable: list[int] = []
        self.takeovers = [_Takeover(self, *told) for told in self._decode(TOOK_OVER, TookOver)]
        self.handovers = list(self._decode(_HANDED_OVER, HandedOver))
        self.names = {takeover.detail.appliance for takeover in self.takeovers}
        self.epochs = {takeover.epoch for takeover in self.takeovers}

    def _decode(self, event: str, kind: type[_T]) -> Iterator[tuple[int, int, _T]]:
        for row in self._rows:
            if row.event == event:
                try:
                    yield row.sequence, row.time, msgspec.json.decode(row.detail, type=kind)
                except (ValueError, RecursionError, MemoryError):
                    self.unreadable.append(row.sequence)

    def _hash(self, sequence: int) -> bytes | None:
        digest = record_hash(self._connection, sequence)
        return digest if isinstance(digest, bytes) else None

    def _checkpoint(self, number: int) -> bytes:
        row = self._connection.execute("SELECT text FROM checkpoint WHERE number = ?", (number,)).fetchone()
        return b"" if row is None else row[0]

    def between(self, after: int, through: int, *events: str) -> Iterator[EventRow]:
        for place in range(bisect_right(self._rows, after, key=_SEQUENCE), len(self._rows)):
            if self._rows[place].sequence > through:
                return
            if self._rows[place].event in events:
                yield self._rows[place]

    def last_decision(self, after: int, through: int) -> EventRow | None:
        return max(self.between(after, through, _DECISION), default=None)

    def before(self, sequence: int) -> _Takeover | None:
        place = bisect_left(self.takeovers, sequence, key=_SEQUENCE)
        return self.takeovers[place - 1] if place else None

    def end_of(self, sequence: int, epoch: int = -1) -> int:
        later = islice(self.takeovers, bisect_right(self.takeovers, sequence, key=_SEQUENCE), None)
        return next((one.sequence - 1 for one in later if one.epoch > epoch), self.result.last)

    def stayed(self, sequence: int) -> int | None:
        failed = next(self.between(sequence, self.end_of(sequence), _STAYED), None)
        return None if failed is None else failed.sequence

    def names_of(self, absent: str) -> Iterator[TakeoverFinding]:
        kind = TakeoverFindingKind.LOG_MISSING
        for takeover in self.takeovers:
            previous = takeover.detail.previous
            if takeover.detail.checkpoint is not None or (previous and previous.appliance == absent):
                message = f"record {takeover.sequence} names the log of {absent}, which is missing"
                yield TakeoverFinding(kind, takeover.epoch, message)
        for sequence, _time, handed in self.handovers:
            if self.stayed(sequence) is None:
                message = f"record {sequence} hands over to {absent}, whose log is missing"
                yield TakeoverFinding(kind, handed.epoch, message)


class _Walk:
    """A walk along the takeovers of two logs, in the order of their epochs."""

    def __init__(self, findings: list[TakeoverFinding], proofs: list[TakeoverProof]) -> None:
        self._findings, self._proofs = findings, proofs

    def along(self, first: _Log, second: _Log) -> None:
        first.other, second.other = second, first
        if first.result.log == second.result.log:
            message = f"both are log {first.result.log}: give the logs of the two appliances"
            self._find(TakeoverFindingKind.SAME_LOG, 0, message)
            return
        for log in (first, second):
            self._check_one_log(log)
        placed = sorted(first.takeovers + second.takeovers, key=lambda one: one.epoch)
        for one, following in pairwise(placed):
            if one.epoch == following.epoch and one.log is not following.log:
                message = f"both logs have a takeover of epoch {one.epoch}"
                self._find(TakeoverFindingKind.EPOCH_ORDER, one.epoch, message)
        turns = [list(turn) for _, turn in groupby(placed, key=lambda one: one.log is first)]
        overlaps = {
            active[0]: self._overlap(before[-1], active, back[0])
            for before, active, back in zip(turns, turns[1:], turns[2:], strict=False)
        }
        for one in placed:
            self._check_names(one)
            self._proofs.append(self._proof(one, overlaps.get(one, "unknown")))

    def _find(self, kind: TakeoverFindingKind, epoch: int, message: str) -> None:
        name = f"epoch {epoch}: " if epoch else ""
        self._findings.append(TakeoverFinding(kind, epoch, name + message))

    def _check_one_log(self, log: _Log) -> None:
        name = log.result.log
        for sequence in sorted(log.unreadable):
            message = f"record {sequence} of log {name} does not have the detail of its event"
            self._find(TakeoverFindingKind.UNREADABLE, 0, message)
        for takeover, following in pairwise(log.takeovers):
            if following.epoch <= takeover.epoch:
                message = (
                    f"record {following.sequence} of log {name} comes after epoch {takeover.epoch},"
                    f" record {takeover.sequence}"
                )
                self._find(TakeoverFindingKind.EPOCH_ORDER, following.epoch, message)
        for sequence, time, handed in log.handovers:
            held = log.before(sequence)
            if held is not None and (held.epoch, held.detail.other) != (handed.epoch, handed.to):
                message = (
                    f"record {sequence} of log {name} hands it over to {handed.to}, but the"
                    f" appliance took over in epoch {held.epoch} from {held.detail.other}"
                )
                self._find(TakeoverFindingKind.EPOCH_ORDER, handed.epoch, message)
            late = log.last_decision(sequence, log.stayed(sequence) or log.end_of(sequence))
            if late is None or any(log.between(sequence, late.sequence, *_CLOCK_SET)):
                continue
            if late.time - time > _TOLERANCE:
                message = (
                    f"{handed.appliance} handed over in record {sequence} of log {name}, and"
                    f" decided again in record {late.sequence} before it took over"
                )
                self._find(TakeoverFindingKind.OVERLAP, handed.epoch, message)

    def _check_names(self, takeover: _Takeover) -> None:
        detail, other = takeover.detail, takeover.log.other
        if detail.appliance in other.names or (other.names and detail.other not in other.names):
            message = (
                f"{detail.appliance} took over from {detail.other}, but the other log is of"
                f" {', '.join(sorted(other.names))}"
            )
            self._find(TakeoverFindingKind.WRONG_NAME, takeover.epoch, message)
        previous = detail.previous
        if previous is None:
            return
        log = takeover.log if previous.appliance == detail.appliance else other
        if previous.epoch >= takeover.epoch:
            message = f"it names epoch {previous.epoch} as the one before it"
            self._find(TakeoverFindingKind.EPOCH_ORDER, takeover.epoch, message)
        elif previous.epoch not in log.epochs and not (
            log.result.removed and previous.epoch < min(log.epochs, default=previous.epoch + 1)
        ):
            message = (
                f"{previous.appliance} took over in this epoch, as the takeover of epoch {takeover.epoch} names it; log"
                f" {log.result.log} does not have the record: it was removed, or the copy is older"
            )
            self._find(TakeoverFindingKind.TAKEOVER_MISSING, previous.epoch, message)

    def _link(self, takeover: _Takeover) -> Link:
        named, other = takeover.detail.checkpoint, takeover.log.other
        if named is None:
            return "none"
        sealed, fault = other.before(named.sequence + 1), named.fault_in(other.known)
        if fault is not None:
            kind, words = _WRONG[fault]
        elif sealed is not None and sealed.epoch > takeover.epoch:
            kind, words = TakeoverFindingKind.EPOCH_ORDER, _LATER_EPOCH
        else:
            return "removed" if named.sequence <= other.result.removed else "proven"
        words = words.format(named=named, log=other.known, sealed=sealed)
        message = f"{takeover.detail.appliance} took over and named checkpoint {named.number}{words}"
        self._find(kind, takeover.epoch, message)
        return "wrong"

    def _proof(self, takeover: _Takeover, overlap: Overlap) -> TakeoverProof:
        detail, other, link = takeover.detail, takeover.log.other, self._link(takeover)
        through = tail = signed = 0
        if link in ("proven", "removed") and detail.checkpoint is not None:
            through = detail.checkpoint.sequence
            end = other.end_of(through, takeover.epoch)
            tail, signed = end - through, max(0, min(end, other.result.signed_through) - through)
        return TakeoverProof(
            epoch=takeover.epoch, appliance=detail.appliance, other=detail.other, log=takeover.log.result.log,
            sequence=takeover.sequence, time=takeover.time, link=link, through=through, tail=tail, tail_signed=signed,
            overlap=overlap,
        )  # fmt: skip

    def _overlap(self, before: _Takeover, active: list[_Takeover], back: _Takeover) -> Overlap:
        """Compare the silence of one appliance with the epochs of the other.

        `before` and `back` are takeovers of the first appliance, `active` those of the other between them. `active`
        ends with the last decision of each epoch; the silence is the time from the last decision before to `back`.
        """
        silent, busy = before.log, active[0].log
        last = silent.last_decision(before.sequence, back.sequence)
        resumed = next(silent.between(back.sequence, silent.result.last, _DECISION), None)
        heard = resumed.sequence if resumed else silent.result.last
        if last is None or any(silent.between(last.sequence, heard, *_CLOCK_SET)):
            return "unknown"
        duration = 0
        for one in active:
            decided = busy.last_decision(one.sequence, busy.end_of(one.sequence))
            if decided is None:
                continue
            if any(busy.between(one.sequence, decided.sequence, *_CLOCK_SET)):
                return "unknown"
            duration += max(0, decided.time - one.time)
        if not duration:
            return "unknown"
        overlap = duration - (back.time - last.time) - _TOLERANCE - duration // _DRIFT
        if overlap <= 0:
            return "excluded"
        message = (
            f"{before.detail.appliance} decided for at least {overlap / _SECOND:.0f} s after"
            f" {active[0].detail.appliance} had taken over, or one of their clocks was set while the machine was off"
        )
        self._find(TakeoverFindingKind.OVERLAP, active[0].epoch, message)
        return "found"


_REWRITTEN = (
    TakeoverFindingKind.REWRITTEN,
    "; record {named.sequence} of the other log is not the one that it sealed: the records up to there were rewritten",
)
_LATER_EPOCH = (
    ", which seals the takeover of epoch {sealed.detail.epoch}, record {sealed.sequence} of the other log"
)
_WRONG = {
    ProofFault.LOG: (
        TakeoverFindingKind.LOG_REPLACED,
        " of log {named.log}; the other log is {log.id}: it is of another pair, or took its place",
    ),
    ProofFault.KEY: (TakeoverFindingKind.WRONG_KEY, ", signed with {named.key}; expected is {log.key}"),
    ProofFault.SIGNATURE: (TakeoverFindingKind.SIGNATURE_WRONG, ": its signature is wrong"),
    ProofFault.CUT_OFF: (
        TakeoverFindingKind.TRUNCATED,
        ", which sealed record {named.sequence}; the other log ends with record {log.last}: its end was cut off, or the"
        " copy is older",
    ),
    ProofFault.MISSING: _REWRITTEN,
    ProofFault.REWRITTEN: _REWRITTEN,
    ProofFault.OTHER: (TakeoverFindingKind.CHECKPOINT_CHANGED, "; the other log has a different one"),
}


def verification(
    own: Path, verified: Verification, other: Path, state: Path, verify: Callable[[], Verification]
) -> tuple[PairVerification, Callable[[PairVerification], None]]:
    first, missing = VerifiedLog(own, verified), _absent(other, state)
    logs = (first,) if missing else (first, VerifiedLog(other, verify()))
    return verify_takeovers(*logs, absent=missing), print_pair


def _absent(log: Path, state: Path) -> str:
    if log.exists():
        return ""
    try:
        membership = load_membership(path_of(state))
    except MembershipError as error:
        fail(str(error), 2)
    return membership.name if membership is not None else ""


def print_pair(pair: PairVerification) -> None:
    names = {takeover.log: takeover.appliance for takeover in pair.takeovers}
    for result in pair.logs:
        if result.log in names:
            write(f"Log of {names[result.log]}:")
        print_verification(result)
        write("")
    for finding in pair.findings:
        write(f"{finding.kind.value.upper()}: {printable(finding.message)}")
    for takeover in pair.takeovers:
        by = f"{takeover.appliance} took over from {takeover.other}"
        write(f"epoch {takeover.epoch}, {local_text(takeover.time)}: {by} (record {takeover.sequence})")
        for text in _proven(takeover):
            write(f"    {text}")
    write(_verdict(pair))


def _proven(takeover: TakeoverProof) -> Iterator[str]:
    other, through = takeover.other, takeover.through
    match takeover.link:
        case "none":
            yield f"it names no checkpoint of {other}, so it proves nothing about that log"
        case "wrong":
            yield f"it names a checkpoint of {other} that is wrong, see above"
        case "removed":
            yield f"retention has removed the records of {other} up to record {through}, which it names"
        case "proven":
            yield f"the log of {other} agrees with it up to record {through}"
    if through:
        yield (
            f"records of {other} after that, until its next takeover: {takeover.tail};"
            f" later checkpoints seal {takeover.tail_signed}"
        )
    match takeover.overlap:
        case "excluded":
            yield f"{other} decided nothing more until it took over again"
        case "found":
            yield f"{other} went on deciding, see above"
        case "unknown":
            yield f"the logs do not show whether {other} went on deciding"


def _verdict(pair: PairVerification) -> str:
    if not pair.ok:
        return "A log was tampered with or is damaged, or the two logs do not fit together."
    if pair.absent:
        return f"{pair.absent} has no log yet, because it was never active: there is no takeover to verify."
    if not pair.takeovers:
        return "Both logs are consistent, but neither has a takeover: nothing links them."
    count = len(pair.takeovers)
    takeovers, verb = ("the takeover", "is") if count == 1 else (f"the {count} takeovers", "are")
    return f"Both logs are consistent, and so {verb} {takeovers} between them."
