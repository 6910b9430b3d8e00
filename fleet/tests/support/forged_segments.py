"""Make segments of a compromised robot, whose own key seals any content under any number of any log."""

import functools
import hashlib
import secrets
import time
from typing import Any, NamedTuple

from appliance.audit.log.columns import StoredColumns, record_hash, to_columns
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import stored_entry
from appliance.audit.proof.chain_proofs import ChainProof, evidence_line
from appliance.audit.proof.copies import SignedCheckpoint
from appliance.formats.segments import RecordPlace, SegmentHeader, SegmentSummary
from appliance.signing.log_proof import NO_CHECKPOINT, Checkpoint, genesis
from fleet.tests.support.fleet_site import FleetRobot


class _Placed(NamedTuple):
    columns: StoredColumns
    before: bytes
    hash: bytes
    line: bytes


@functools.cache
def _chain(log: str, start: int, records: int, fields: tuple[tuple[str, Any], ...]) -> list[_Placed]:
    digest = genesis(log) if start == 0 else bytes(32)
    placed = []
    for sequence in range(start + 1, start + records + 1):
        usual: dict[str, Any] = {
            "id": f"{sequence:026}", "time": time.time_ns(), "event": "decision", "reason": "x" * 400,
        }  # fmt: skip
        columns = to_columns(AuditRecord(**usual | dict(fields)), sequence)
        before, digest = digest, record_hash(digest, columns)
        placed.append(_Placed(columns, before, digest, _line(columns, before, digest, None)))
    return placed


def _line(columns: StoredColumns, before: bytes, digest: bytes, end: SignedCheckpoint | None) -> bytes:
    proof = ChainProof(previous=before.hex(), hash=digest.hex(), then=[], checkpoint=end)
    return evidence_line(stored_entry(columns), proof).encode() + b"\n"


def forged(
    robot: FleetRobot, records: int, *, log: str = "", number: int = 1, **fields: Any
) -> tuple[SegmentSummary, bytes]:
    log = log or secrets.token_hex(16)
    start = 0 if number == 1 else number
    placed = _chain(log, start, records, tuple(sorted(fields.items())))
    last = placed[-1]
    previous = NO_CHECKPOINT if number == 1 else secrets.token_hex(32)
    text = Checkpoint(log, number, start + records, last.hash.hex(), time.time_ns(), previous).text()
    end = SignedCheckpoint.of(text, robot.key.sign(text), robot.public)
    after = None if number == 1 else RecordPlace(sequence=start, hash=bytes(32).hex())
    header = SegmentHeader(begin=None, after=after, end=end)
    lines = [
        header.line(),
        *(one.line for one in placed[:-1]),
        _line(last.columns, last.before, last.hash, end),
    ]
    body = b"".join(lines)
    return SegmentSummary(hashlib.sha256(body).hexdigest(), header, 0, 0), body
