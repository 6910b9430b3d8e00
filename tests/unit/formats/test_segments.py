import io
import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.audit.proof.chain_proofs import evidence, evidence_line
from appliance.audit.proof.copies import SignedCheckpoint, signed_checkpoints
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
    """Return the first three segments of a real log; its last checkpoint, that of its end, is not signed."""
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
    """Return the bytes of a segment."""
    file = io.BytesIO()
    assert write_segment(path, number, file.write) is not None
    return file.getvalue()


def test_a_segment_is_proven_with_the_key_alone(segments: list[bytes], public: bytes) -> None:
    read = [SegmentReader(io.BytesIO(one), (public,), _LARGEST) for one in segments]
    found = [[columns.sequence for columns in one] for one in read]
    summaries = [one.summary() for one in read]
    assert [one for part in found for one in part] == list(range(1, summaries[-1].last + 1))
    assert summaries[0].header.begin is None
    assert [one.header.begin for one in summaries[1:]] == [one.header.end for one in summaries[:-1]]
    assert len({one.name for one in summaries}) == 3


def test_its_records_are_the_lines_of_an_export(segments: list[bytes], path: Path) -> None:
    lines = [line for one in segments for line in one.decode("ascii").splitlines()[1:]]
    exported = [evidence_line(entry, chain) for entry, chain in evidence(path, Filter())]
    assert lines == exported[: len(lines)]


def test_an_unsigned_checkpoint_has_no_segment_yet(segments: list[bytes], path: Path) -> None:
    assert (len(segments), signed_checkpoints(path)[-1].number) == (3, 4)
    assert [write_segment(path, number, lambda _line: None) for number in (5, 6)] == [None, None]


def _lines(change: Callable[[list[bytes]], list[bytes]]) -> Callable[[bytes], bytes]:
    return lambda one: b"".join(change(one.splitlines(keepends=True)))


def _fields(**changes: object) -> Callable[[bytes], bytes]:
    def change(lines: list[bytes]) -> list[bytes]:
        fields = json.loads(lines[2]) | changes
        return [*lines[:2], json.dumps(fields, separators=(",", ":")).encode() + b"\n", *lines[3:]]

    return _lines(change)


CHANGES = {
    "changed record": (_fields(host="10.9.9.9"), "does not follow"),
    "renumbered record": (_fields(sequence=999), "does not follow"),
    "removed record": (_lines(lambda lines: lines[:2] + lines[3:]), "does not follow"),
    "removed end": (_lines(lambda lines: lines[:-1]), "missing at its end"),
    "swapped records": (_lines(lambda lines: [lines[0], lines[2], lines[1], *lines[3:]]), "does not follow"),
    "repeated end": (_lines(lambda lines: [*lines, lines[-1]]), "more records"),
    "cut line": (lambda one: one[:-7], "was cut"),
    "no records": (_lines(lambda lines: lines[:1]), "missing at its end"),
    "nothing": (lambda _one: b"", "line 1"),
    "another spelling": (lambda one: one.replace(b'"schema":1,', b'"schema": 1,', 1), "one valid spelling"),
    "a further field": (lambda one: one.replace(b'"schema":1,', b'"schema":1,"x":1,', 1), "one valid spelling"),
    "a field twice": (lambda one: one.replace(b'"schema":1,', b'"schema":1,"schema":1,', 1), "one valid spelling"),
    "header spelt differently": (lambda one: one.replace(b'{"segment":1,', b'{"segment": 1,', 1), "one valid spelling"),
    "another version": (lambda one: one.replace(b'{"segment":1,', b'{"segment":2,', 1), "version 2"),
    "no beginning": (_lines(lambda lines: [_without_begin(lines[0]), *lines[1:]]), "does not follow"),
    "deep": (lambda one: one + b"[" * 100_000 + b"\n", "more records"),
}  # fmt: skip


def _without_begin(line: bytes) -> bytes:
    return (
        json.dumps(json.loads(line) | {"begin": None, "after": None}, separators=(",", ":")).encode() + b"\n"
    )


@pytest.mark.nightly
@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_segment_is_refused(name: str, segments: list[bytes], public: bytes) -> None:
    change, why = CHANGES[name]
    with pytest.raises(SegmentError, match=why):
        SegmentReader(io.BytesIO(change(segments[1])), (public,), _LARGEST).summary()


def test_a_segment_of_another_key_is_refused(segments: list[bytes]) -> None:
    other = Ed25519PrivateKey.generate().public_key().public_bytes_raw()
    with pytest.raises(SegmentError, match="is signed with"):
        SegmentReader(io.BytesIO(segments[0]), (other,), _LARGEST)


def test_a_forged_checkpoint_is_refused(segments: list[bytes], public: bytes) -> None:
    lines = segments[1].splitlines(keepends=True)
    header = json.loads(lines[0])
    end = SignedCheckpoint(**header["end"])
    forged = Ed25519PrivateKey.generate().sign(end.text()).hex()
    lines[0] = (
        json.dumps(header | {"end": header["end"] | {"signature": forged}}, separators=(",", ":")).encode()
        + b"\n"
    )
    with pytest.raises(SegmentError, match="signature of checkpoint 2 is wrong"):
        SegmentReader(io.BytesIO(b"".join(lines)), (public,), _LARGEST)


def test_a_large_segment_is_refused_early(segments: list[bytes], public: bytes) -> None:
    file = io.BytesIO(segments[1] + b"x" * _LARGEST)
    with pytest.raises(SegmentError, match="larger than the limit"):
        SegmentReader(file, (public,), len(segments[1]) - 1).summary()
    assert file.tell() <= len(segments[1])


def test_a_segment_after_removed_records_is_proven(segments: list[bytes], path: Path, public: bytes) -> None:
    second, third = (SegmentReader(io.BytesIO(one), (public,), _LARGEST) for one in segments[1:])
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
