"""Prove from the stored segments that no record of a robot is missing.

The segments of a complete log form one chain. It starts at the log's beginning, after records whose removal the
signer signed, or after segments whose removal the collector's own retention noted. The newest segment of a robot, and
the last one of each earlier log, are also noted outside of the log, so their loss is found.
"""

import gzip
import zlib
from datetime import UTC, datetime

import msgspec

from appliance.base.counted import counted
from appliance.formats.segments import SegmentError, SegmentHeader, SegmentReader
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.segment_store import RemovalNote, SegmentPlace, SegmentStore

_MAX_ATTEMPTS = 10  # to prove a log of which retention removes segments at the same time
_UNREADABLE = (SegmentError, OSError, EOFError, zlib.error, gzip.BadGzipFile)


class LogProof(msgspec.Struct, kw_only=True):
    """The result for one log: `records` in `segments` are proven, up to sequence `last`.

    `begins_after` is the last record that the appliance's retention removed before the collector had it. `removed` is
    the last record that the collector removed. `missing` is the number of records that no segment has.
    """

    robot: str
    log: str
    segments: int = 0
    records: int = 0
    begins_after: int = 0
    removed: int = 0
    removal: str = ""
    last: int = 0
    missing: int = 0
    findings: list[str] = []

    @property
    def ok(self) -> bool:
        return not self.findings


def prove(store: SegmentStore, robot: Robot, segment_bytes: int) -> list[LogProof]:
    """Prove each log, and that the robot's newest segment, which the collector noted, is still stored."""
    newest = store.newest(robot.name)  # first: a segment is noted after it is stored
    proofs = {log: _prove_log(store, robot, log, segment_bytes) for log in store.logs(robot.name)}
    if newest is not None:
        _arrived, place = newest
        head = store.head(robot.name, place.log)
        if head is None or head.number < place.number:
            proof = proofs.setdefault(place.log, LogProof(robot=robot.name, log=place.log))
            proof.findings.append(f"segment {place.number}, the newest that arrived, is missing")
    _check_earlier(store, robot, proofs)
    return list(proofs.values())


def _check_earlier(store: SegmentStore, robot: Robot, proofs: dict[str, LogProof]) -> None:
    """Report segments that are missing at the end of logs that the robot pushed before its present one."""
    for log, number in store.earlier(robot.name).items():
        head, (note, _damage) = store.head(robot.name, log), _removal(store, robot, log)
        stored = max(0 if head is None else head.number, 0 if note is None else note.number)
        if stored < number:
            proof = proofs.setdefault(log, LogProof(robot=robot.name, log=log))
            proof.findings.append(f"segment {number}, the last of this log that arrived, is missing")


def _prove_log(store: SegmentStore, robot: Robot, log: str, segment_bytes: int) -> LogProof:
    """Prove a log. Repeat it if retention, which writes its note first, has removed segments during the proof."""
    for _attempt in range(_MAX_ATTEMPTS):
        note, damage = _removal(store, robot, log)
        proof = _proof_after(note, store, robot, log, segment_bytes)
        if proof.ok or _removal(store, robot, log) == (note, damage):
            break
    if damage:
        proof.findings.insert(0, damage)
    return proof


def _removal(store: SegmentStore, robot: Robot, log: str) -> tuple[RemovalNote | None, str]:
    try:
        return store.removal(robot.name, log), ""
    except OSError as error:
        return None, f"the note of removed segments is damaged: {error}"


def _proof_after(
    note: RemovalNote | None, store: SegmentStore, robot: Robot, log: str, segment_bytes: int
) -> LogProof:
    proof = LogProof(robot=robot.name, log=log)
    ends: dict[int, list[SegmentHeader]] = {}
    removed, first = 0, 1
    if note is not None:
        _begin_after(note, proof)
        ends, first = {note.number: note.ends}, note.number + 1
    for place in store.segments(robot.name, log):
        if place.number < first:  # retention removed it, but a crash left its file
            continue
        header = _read(store, robot, place, segment_bytes, proof)
        if header is None:
            continue
        proof.segments += 1
        previous = ends.get(place.number - 1, [])
        if place.number in ends:
            proof.findings.append(
                f"checkpoint {place.number} seals two histories: the log was restored from a copy, or rewritten with"
                " the robot's key"
            )
        elif place.number != 1 and not any(map(header.follows, previous)):
            _note_missing(proof, header)
        if place.number not in ends:
            ends = {number: found for number, found in ends.items() if number == place.number - 1}
        ends.setdefault(place.number, []).append(header)
        proof.records += header.end.sequence - header.start[0]
        proof.last = max(proof.last, header.end.sequence)
        removed = max(removed, header.end.removed or 0)
    if proof.begins_after > removed:
        proof.missing += proof.begins_after
        proof.findings.insert(
            0, f"records 1 to {proof.begins_after} are missing: their removal is not signed"
        )
    return proof


def _begin_after(note: RemovalNote, proof: LogProof) -> None:
    proof.removed = proof.last = max(header.end.sequence for header in note.ends)
    day = datetime.fromtimestamp(note.time // 10**9, UTC).date().isoformat()
    proof.removal = (
        f"records up to {proof.removed} were removed by the collector ({note.by}), the last on {day}:"
        f" {counted(note.segments, 'segment')} with {counted(note.gaps, 'gap')} and {counted(note.forks, 'fork')}"
    )


def _read(
    store: SegmentStore, robot: Robot, place: SegmentPlace, segment_bytes: int, proof: LogProof
) -> SegmentHeader | None:
    try:
        with gzip.open(store.path(place)) as file:
            summary = SegmentReader(file, robot.public_keys, segment_bytes).summary()
    except _UNREADABLE as error:
        proof.findings.append(f"{store.path(place)}: damaged: {error}")
        return None
    end = summary.header.end
    if (end.log, end.number, summary.name) != (place.log, place.number, place.name):
        proof.findings.append(
            f"{store.path(place)}: damaged: its content is segment {end.number} {summary.name}"
        )
        return None
    return summary.header


def _note_missing(proof: LogProof, header: SegmentHeader) -> None:
    begin = header.start[0]
    if header.begin is None and proof.last == 0:
        proof.begins_after = begin
        return
    count = max(0, begin - proof.last)
    proof.missing += count
    proof.findings.append(
        f"records {proof.last + 1} to {begin} are missing"
        if count
        else f"checkpoint {header.end.number} does not continue the segment before it"
    )
