"""Print the verification of two logs and of the takeovers between them."""

import enum
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from appliance.audit.log.log_database import reading
from appliance.audit.log.record_format import printable, rfc3339
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.copies import KnownLog, SignedCheckpoint
from appliance.cli.audit.audit_errors import fail
from appliance.cli.audit.verification_text import print_verification, write
from appliance.features.standby.membership import MembershipError, load_membership, path_of
from appliance.features.standby.takeovers import EpochOf, Handover, Takeover, TakeoverLog
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
_MOST_FINDINGS = 1000
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


def verify_takeovers(first: VerifiedLog, second: VerifiedLog) -> PairVerification:
    findings: list[TakeoverFinding] = []
    proofs: list[TakeoverProof] = []
    with ExitStack() as stack:
        connections = [stack.enter_context(reading(log.path, advice="")) for log in (first, second)]
        try:
            pair = _Pair(*(_opened(*two) for two in zip(connections, (first, second), strict=True)))
            findings, proofs = pair.findings, pair.proofs
            pair.run()
        except sqlite3.DatabaseError as error:
            message = f"the records of takeovers cannot be read: {error}"
            findings.append(TakeoverFinding(TakeoverFindingKind.UNREADABLE, 0, message))
    results = (first.result, second.result)
    ok = not findings and all(result.ok for result in results)
    return PairVerification(ok=ok, logs=results, takeovers=proofs, findings=findings[:_MOST_FINDINGS])


def verify_alone(log: VerifiedLog, absent: str) -> PairVerification:
    """Verify a log without the log of the other appliance: no record may name that log."""
    kind = TakeoverFindingKind.LOG_MISSING
    findings: list[TakeoverFinding] = []
    with reading(log.path, advice="") as connection:
        try:
            found = _opened(connection, log)
            for sequence, _time, took in found.takeovers:
                named = took.checkpoint is not None or (took.previous and took.previous.appliance == absent)
                if named:
                    message = f"record {sequence} names the log of {absent}, which is missing"
                    findings.append(TakeoverFinding(kind, took.epoch, message))
            for sequence, _time, handed in found.handovers:
                if found.stayed(sequence, found.end_of(sequence)) is None:
                    message = f"record {sequence} hands over to {absent}, whose log is missing"
                    findings.append(TakeoverFinding(kind, handed.epoch, message))
        except sqlite3.DatabaseError as error:
            message = f"the records of takeovers cannot be read: {error}"
            findings.append(TakeoverFinding(TakeoverFindingKind.UNREADABLE, 0, message))
    return PairVerification(
        ok=not findings and log.result.ok,
        logs=(log.result,),
        takeovers=[],
        findings=findings[:_MOST_FINDINGS],
        absent=absent,
    )


def _opened(connection: sqlite3.Connection, log: VerifiedLog) -> TakeoverLog:
    connection.execute("BEGIN")
    return TakeoverLog(connection, log.result)


class _Placed(NamedTuple):
    takeover: Takeover
    own: TakeoverLog
    other: TakeoverLog

    @property
    def epoch(self) -> int:
        return self.takeover.detail.epoch


class _Pair:
    def __init__(self, first: TakeoverLog, second: TakeoverLog) -> None:
        self._sides = ((first, second), (second, first))
        placed = [_Placed(one, own, other) for own, other in self._sides for one in own.takeovers]
        self._placed = sorted(placed, key=lambda one: one.epoch)
        self.findings: list[TakeoverFinding] = []
        self.proofs: list[TakeoverProof] = []

    def run(self) -> None:
        (first, second), _ = self._sides
        if first.result.log == second.result.log:
            message = f"both are log {first.result.log}: give the logs of the two appliances"
            self._find(TakeoverFindingKind.SAME_LOG, 0, message)
            return
        for own, _ in self._sides:
            self._check_one_log(own)
        for one, following in pairwise(self._placed):
            if one.epoch == following.epoch and one.own is not following.own:
                message = f"both logs have a takeover of epoch {one.epoch}"
                self._find(TakeoverFindingKind.EPOCH_ORDER, one.epoch, message)
        overlaps = dict(self._overlaps())
        for place, one in enumerate(self._placed):
            self._check_names(one)
            self._check_previous(one)
            link = self._check_checkpoint(one)
            self.proofs.append(_proof(one, link, overlaps.get(place, "unknown")))

    def _find(self, kind: TakeoverFindingKind, epoch: int, message: str) -> None:
        name = f"epoch {epoch}: " if epoch else ""
        self.findings.append(TakeoverFinding(kind, epoch, name + message))

    # --- one log ----------------------------------------------------------------------------------------------

    def _check_one_log(self, log: TakeoverLog) -> None:
        for sequence in log.unreadable:
            message = f"record {sequence} of log {log.result.log} does not have the detail of its event"
            self._find(TakeoverFindingKind.UNREADABLE, 0, message)
        for one, following in pairwise(log.takeovers):
            epoch = following.detail.epoch
            if epoch <= one.detail.epoch:
                message = (
                    f"record {following.sequence} of log {log.result.log} comes after epoch {one.detail.epoch},"
                    f" record {one.sequence}"
                )
                self._find(TakeoverFindingKind.EPOCH_ORDER, epoch, message)
        for handover in log.handovers:
            epoch, sequence = handover.detail.epoch, handover.sequence
            held = log.before(sequence)
            if held is not None and (held.detail.epoch, held.detail.other) != (epoch, handover.detail.to):
                message = (
                    f"record {sequence} of log {log.result.log} hands it over to {handover.detail.to}, but the"
                    f" appliance took over in epoch {held.detail.epoch} from {held.detail.other}"
                )
                self._find(TakeoverFindingKind.EPOCH_ORDER, epoch, message)
            self._check_silence(log, handover)

    def _check_silence(self, log: TakeoverLog, handover: Handover) -> None:
        end = log.end_of(handover.sequence)
        late = log.last_decision(handover.sequence, log.stayed(handover.sequence, end) or end)
        if late is None or log.clock_was_set(handover.sequence, late.sequence):
            return
        if late.time - handover.time > _TOLERANCE:
            message = (
                f"{handover.detail.appliance} handed over in record {handover.sequence} of log {log.result.log}, and"
                f" decided again in record {late.sequence} before it took over"
            )
            self._find(TakeoverFindingKind.OVERLAP, handover.detail.epoch, message)

    # --- the links between the logs ---------------------------------------------------------------------------

    def _check_names(self, one: _Placed) -> None:
        name, named = one.takeover.detail.appliance, one.takeover.detail.other
        if name in one.other.names or (one.other.names and named not in one.other.names):
            message = (
                f"{name} took over from {named}, but the other log is of {', '.join(sorted(one.other.names))}"
            )
            self._find(TakeoverFindingKind.WRONG_NAME, one.epoch, message)

    def _check_previous(self, one: _Placed) -> None:
        previous = one.takeover.detail.previous
        if previous is None:
            return
        if previous.epoch >= one.epoch:
            message = f"it names epoch {previous.epoch} as the one before it"
            self._find(TakeoverFindingKind.EPOCH_ORDER, one.epoch, message)
            return
        log = one.own if previous.appliance == one.takeover.detail.appliance else one.other
        if not _has(log, previous):
            message = (
                f"{previous.appliance} took over in this epoch, as the takeover of epoch {one.epoch} names it; log"
                f" {log.result.log} does not have the record: it was removed, or the copy is older"
            )
            self._find(TakeoverFindingKind.TAKEOVER_MISSING, previous.epoch, message)

    def _check_checkpoint(self, one: _Placed) -> Link:
        named = one.takeover.detail.checkpoint
        if named is None:
            return "none"
        wrong = _wrong_checkpoint(named, one.other)
        if wrong is None and (contradiction := _later_epoch(one, named)) is not None:
            wrong = TakeoverFindingKind.EPOCH_ORDER, contradiction
        if wrong is not None:
            kind, message = wrong
            self._find(kind, one.epoch, f"{one.takeover.detail.appliance} took over and named {message}")
            return "wrong"
        return "removed" if named.sequence <= one.other.result.removed else "proven"

    # --- overlapping epochs -----------------------------------------------------------------------------------

    def _overlaps(self) -> Iterator[tuple[int, Overlap]]:
        switches = [
            place for place, two in enumerate(pairwise(self._placed), 1) if two[0].own is not two[1].own
        ]
        for place, end in pairwise(switches):
            one, active, back = self._placed[place - 1], self._placed[place:end], self._placed[end]
            overlap = _overlap(one, active, back)
            if overlap is None:
                continue
            if overlap > 0:
                first = active[0]
                message = (
                    f"{one.takeover.detail.appliance} decided for at least {overlap / _SECOND:.0f} s after"
                    f" {first.takeover.detail.appliance} had taken over, or one of their clocks was set while the"
                    " machine was off"
                )
                self._find(TakeoverFindingKind.OVERLAP, first.epoch, message)
            yield place, "found" if overlap > 0 else "excluded"


def _has(log: TakeoverLog, previous: EpochOf) -> bool:
    if previous.epoch in log.epochs:
        return True
    return log.result.removed > 0 and (log.first_epoch is None or previous.epoch < log.first_epoch)


_REWRITTEN = (
    TakeoverFindingKind.REWRITTEN,
    "; record {named.sequence} of the other log is not the one that it sealed: the records up to there were rewritten",
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


def _wrong_checkpoint(named: SignedCheckpoint, log: TakeoverLog) -> tuple[TakeoverFindingKind, str] | None:
    """Return the fault of a named checkpoint; None if it is right, or if its records were removed."""
    first, last, key = log.result.removed + 1, log.result.last, log.result.key or "no key"
    known = KnownLog(log.result.log, key, first, last, log.hash_at, log.checkpoint_text)
    fault = named.fault_in(known)
    if fault is None:
        return None
    kind, words = _WRONG[fault]
    return kind, f"checkpoint {named.number}{words.format(named=named, log=known)}"


def _later_epoch(one: _Placed, named: SignedCheckpoint) -> str | None:
    sealed = one.other.before(named.sequence + 1)
    if sealed is None or sealed.detail.epoch <= one.epoch:
        return None
    return (
        f"checkpoint {named.number}, which seals the takeover of epoch {sealed.detail.epoch}, record"
        f" {sealed.sequence} of the other log"
    )


def _proof(
    one: _Placed,
    link: Link,
    overlap: Overlap,
) -> TakeoverProof:
    detail, other = one.takeover.detail, one.other
    through = tail = signed = 0
    if link in ("proven", "removed") and detail.checkpoint is not None:
        through = detail.checkpoint.sequence
        end = other.end_of(through, one.epoch)
        tail, signed = end - through, max(0, min(end, other.result.signed_through) - through)
    return TakeoverProof(
        epoch=one.epoch, appliance=detail.appliance, other=detail.other, log=one.own.result.log,
        sequence=one.takeover.sequence, time=one.takeover.time, link=link, through=through, tail=tail,
        tail_signed=signed, overlap=overlap,
    )  # fmt: skip


def _overlap(before: _Placed, active: list[_Placed], back: _Placed) -> int | None:
    """Return the nanoseconds by which one appliance's silence is too short for the other's epochs, or None.

    `before` and `back` are takeovers of the first appliance, `active` those of the other between them. `active` ends
    with the last decision of each epoch; the silence is the time from the last decision before to `back`.
    """
    silent, busy = before.own, active[0].own
    last = silent.last_decision(before.takeover.sequence, back.takeover.sequence)
    if last is None:
        return None
    resumed = silent.first_decision(back.takeover.sequence, silent.result.last)
    if silent.clock_was_set(last.sequence, resumed.sequence if resumed else silent.result.last):
        return None
    duration = 0
    for one in active:
        begin, end = one.takeover.sequence, busy.end_of(one.takeover.sequence)
        decided = busy.last_decision(begin, end)
        if decided is None:
            continue
        if busy.clock_was_set(begin, decided.sequence):
            return None
        duration += max(0, decided.time - one.takeover.time)
    if not duration:
        return None
    missing = duration - (back.takeover.time - last.time)
    return max(0, missing - _TOLERANCE - duration // _DRIFT)


def verification(
    own: Path, verified: Verification, other: Path, state: Path, verify: Callable[[], Verification]
) -> tuple[PairVerification, Callable[[PairVerification], None]]:
    first, missing = VerifiedLog(own, verified), _absent(other, state)
    pair = verify_alone(first, missing) if missing else verify_takeovers(first, VerifiedLog(other, verify()))
    return pair, print_pair


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
        write(f"epoch {takeover.epoch}, {rfc3339(takeover.time)}: {by} (record {takeover.sequence})")
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
