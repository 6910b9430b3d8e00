import io
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.audit.proof.chain_proofs import evidence, evidence_line
from appliance.audit.proof.copies import signed_checkpoints
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.formats.segments import (
    RecordPlace,
    SegmentError,
    SegmentHeader,
    SegmentReader,
    next_segment,
    write_segment,
)
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import first_sequence, make_old, retain

_LARGEST = 1 << 20


@pytest.fixture
def public(key: Ed25519PrivateKey) -> bytes:
    return key.public_key().public_bytes_raw()


@pytest.fixture
def segments(make_log: MakeLog, path: Path) -> list[bytes]:
    log = make_log(checkpoint_every=5)
    fill(log, 21)
    assert len(signed_checkpoints(path)) == 4
    assert log.close() is None
    return [written(path, number) for number in (1, 2, 3)]


def fill(log: AuditLog, count: int) -> None:
    for number in range(count):
        strange = {"detail": {"text": "naïve\0\x1b", "value": 0.1}, "reason": "a\0b", "caller_id": "/x\u202e"}
        log.record(decision(log, number, **(strange if number % 3 == 0 else {})))
        if number % 5 == 4:
            settle(log)


def written(path: Path, number: int) -> bytes:
    file = io.BytesIO()
    assert write_segment(path, number, file.write) is not None
    return file.getvalue()


def test_a_segment_is_proven_with_the_key_alone(segments: list[bytes], public: bytes) -> None:
    read = [SegmentReader(io.BytesIO(segment), (public,), _LARGEST) for segment in segments]
    found = [[columns.sequence for columns in one] for one in read]
    summaries = [one.summary() for one in read]
    assert [one for part in found for one in part] == list(range(1, summaries[-1].last + 1))
    assert summaries[0].header.begin is None
    assert [one.header.begin for one in summaries[1:]] == [one.header.end for one in summaries[:-1]]
    assert len({summary.name for summary in summaries}) == 3


def test_its_records_are_the_lines_of_an_export(segments: list[bytes], path: Path) -> None:
    lines = [line for segment in segments for line in segment.decode("ascii").splitlines()[1:]]
    exported = [evidence_line(entry, chain) for entry, chain in evidence(path, Filter())]
    assert lines == exported[: len(lines)]


def test_an_unsigned_checkpoint_has_no_segment_yet(segments: list[bytes], path: Path) -> None:
    assert (len(segments), signed_checkpoints(path)[-1].number) == (3, 4)
    assert [write_segment(path, number, lambda _line: None) for number in (5, 6)] == [None, None]


def test_a_large_segment_is_refused_early(segments: list[bytes], public: bytes) -> None:
    file = io.BytesIO(segments[1] + b"x" * _LARGEST)
    with pytest.raises(SegmentError, match="larger than the limit"):
        SegmentReader(file, (public,), len(segments[1]) - 1).summary()
    assert file.tell() <= len(segments[1])


def test_a_segment_after_removed_records_is_proven(segments: list[bytes], path: Path, public: bytes) -> None:
    second, third = (SegmentReader(io.BytesIO(segment), (public,), _LARGEST) for segment in segments[1:])
    second.summary()
    removed = second.header.end
    header = SegmentHeader(
        begin=None, after=RecordPlace(sequence=removed.sequence, hash=removed.hash), end=third.header.end
    )
    assert header.follows(second.header)
    rest = b"".join(segments[2].splitlines(keepends=True)[1:])
    assert (
        SegmentReader(io.BytesIO(header.line() + rest), (public,), _LARGEST).summary().first
        == removed.sequence + 1
    )
    wrong = msgspec.structs.replace(header, after=RecordPlace(sequence=removed.sequence, hash="0" * 64))
    assert not wrong.follows(second.header)
    with pytest.raises(SegmentError, match="does not follow"):
        SegmentReader(io.BytesIO(wrong.line() + rest), (public,), _LARGEST).summary()


def test_retention_leaves_a_segment_after_the_removed_records(
    make_log: MakeLog, path: Path, notary: Notary, public: bytes
) -> None:
    make_old(make_log, notary)
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    log.record(decision(log))
    retain(log)
    assert first_sequence(path) > 1900
    settle(log)
    number = next_segment(path, 0)
    assert number is not None
    assert number > 1
    read = SegmentReader(io.BytesIO(written(path, number)), (public,), _LARGEST)
    first = next(export(path, Filter(), page=1)).sequence
    assert (read.summary().first, read.header.begin) == (first, None)
    assert write_segment(path, number - 1, lambda _line: None) is None
