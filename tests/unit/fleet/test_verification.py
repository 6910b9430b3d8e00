import asyncio
import gzip
import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.push_routes import check_segment
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore, read_header
from rosrv_fleet.verification import LogProof, prove

from appliance.formats.segments import SegmentSummary, write_segment
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, Notary, key, make_log, notary, path

__all__ = ["MakeLog", "Notary", "key", "make_log", "notary", "path"]  # fixtures and their types

_OLD = 1_500_000_000 * 10**9


def _remove_once(patch: pytest.MonkeyPatch, remove: Callable[[], object], *, listed: bool) -> None:
    """Call `remove` once, after a proof has listed the files, or with `listed=False` before."""
    segments, calls = SegmentStore.segments, itertools.count()

    def listing(store: SegmentStore, robot: str, log: str) -> Iterator[SegmentPlace]:
        before = list(segments(store, robot, log))
        if next(calls) == 0:
            remove()
        yield from before if listed else segments(store, robot, log)

    patch.setattr(SegmentStore, "segments", listing)


@pytest.fixture
def store(make_log: MakeLog, path: Path, tmp_path: Path) -> SegmentStore:
    segment_store = SegmentStore(tmp_path / "data", 0)
    _push(segment_store, make_log, path, tmp_path)
    return segment_store


def _push(segment_store: SegmentStore, make_log: MakeLog, path: Path, tmp_path: Path) -> None:
    log = make_log(checkpoint_every=10)
    for number in range(50):
        log.record(decision(log, number))
        if number % 10 == 9:
            settle(log)
    asyncio.run(asyncio.wait_for(log.wait_signed(), 60))
    for number in itertools.count(1):
        lines: list[bytes] = []
        summary = write_segment(path, number, lines.append)
        if summary is None:
            break
        upload = tmp_path / "upload"
        upload.write_bytes(gzip.compress(b"".join(lines)))
        place = segment_store.keep("arm1", upload, summary, 1)
        upload.unlink()
        os.utime(segment_store.path(place), (1e9, 1e9))
        segment_store.mark_indexed(place)
    assert log.close() is None


def _places(store: SegmentStore) -> list[SegmentPlace]:
    (log,) = store.logs("arm1")
    return list(store.segments("arm1", log))


def _proof(store: SegmentStore, key: Ed25519PrivateKey) -> LogProof:
    robot = Robot(name="arm1", key=key.public_key().public_bytes_raw().hex(), certificate="", added=0)
    (proof,) = prove(store, robot, 1 << 20)
    return proof


@pytest.mark.parametrize("listed", [True, False])
def test_retention_during_a_proof_loses_nothing(
    listed: bool, store: SegmentStore, key: Ed25519PrivateKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    (log,) = store.logs("arm1")
    whole, number = _proof(store, key), len(_places(store))
    assert (whole.findings, whole.segments) == ([], number)
    _remove_once(
        monkeypatch, lambda: store.prune("arm1", log, _OLD, "retention.segment_days: 30"), listed=listed
    )
    proof = _proof(store, key)
    assert (proof.findings, proof.segments, proof.last) == ([], 1, whole.last)
    assert f"{number - 1} segments with 0 gaps" in proof.removal


@pytest.mark.parametrize("listed", [True, False])
def test_a_removal_without_a_note_is_a_loss(
    listed: bool, store: SegmentStore, key: Ed25519PrivateKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    (log,) = store.logs("arm1")
    places = _places(store)
    os.utime(store.path(places[1]))
    lost = store.header(places[2])
    first, last = lost.start[0] + 1, lost.end.sequence
    store.prune("arm1", log, _OLD, "retention.segment_days: 30")
    _remove_once(monkeypatch, store.path(places[2]).unlink, listed=listed)
    proof = _proof(store, key)
    assert (proof.segments, proof.missing) == (len(places) - 2, last - first + 1)
    assert f"records {first} to {last} are missing" in proof.findings


def test_an_earlier_log_that_is_no_longer_stored_is_a_loss(
    store: SegmentStore, make_log: MakeLog, path: Path, tmp_path: Path, key: Ed25519PrivateKey
) -> None:
    """The robot began a new log; the collector has the last segment of each, or a note of its removal."""
    (first,) = store.logs("arm1")
    path.unlink()
    _push(store, make_log, path, tmp_path)
    robot = Robot(name="arm1", key=key.public_key().public_bytes_raw().hex(), certificate="", added=0)

    def proven() -> dict[str, list[str]]:
        return {proof.log: proof.findings for proof in prove(store, robot, 1 << 20)}

    both = proven()
    assert (len(both), list(both.values())) == (2, [[], []])
    places = list(store.segments("arm1", first))
    store.path(places[-1]).rename(tmp_path / "last")
    assert proven()[first] == [f"segment {places[-1].number}, the last of this log that arrived, is missing"]
    (tmp_path / "last").rename(store.path(places[-1]))
    assert proven() == both
    shutil.rmtree(store.path(places[0]).parent.parent)
    assert first in proven()
    assert len(proven()[first]) == 1


_EMPTY = gzip.compress(b"", 1)


@pytest.mark.parametrize(
    ("packed", "reason"),
    [
        (lambda header, rest: gzip.compress(header + rest), ""),
        (lambda header, rest: gzip.compress(header) + _EMPTY * 1000 + gzip.compress(rest), ""),
        (lambda header, rest: _EMPTY + gzip.compress(header + rest), "not at the beginning"),
        (lambda header, rest: gzip.compress(header[:9]) + gzip.compress(header[9:] + rest), "not at the beg"),
        (
            lambda header, rest: gzip.compress(header) + _EMPTY * 5000 + gzip.compress(rest),
            "larger compressed",
        ),
        (lambda header, rest: gzip.compress(header + rest) + _EMPTY * 5000, "larger compressed"),
        (lambda header, rest: gzip.compress(header + rest) + bytes(100_000), "larger compressed"),
    ],
    ids=["plain", "padded", "empty first", "divided header", "empty later", "empty last", "zeros last"],
)
def test_a_stored_segment_costs_its_readers_no_more_than_its_content(
    packed: Callable[[bytes, bytes], bytes],
    reason: str,
    store: SegmentStore,
    key: Ed25519PrivateKey,
    tmp_path: Path,
) -> None:
    """A compromised robot compresses as it likes, and the collector's main process reads the stored headers."""
    place, upload = _places(store)[0], tmp_path / "upload"
    header, end, rest = gzip.decompress(store.path(place).read_bytes()).partition(b"\n")
    upload.write_bytes(packed(header + end, rest))
    verdict = check_segment(upload, (key.public_key().public_bytes_raw(),), 1 << 20, 60)
    assert (reason in verdict.reason, verdict.summary is None) == (True, bool(reason))
    if not reason:
        assert read_header(upload) == store.header(place)


def test_a_stored_segment_whose_header_comes_late_is_asked_for_again(
    store: SegmentStore, tmp_path: Path
) -> None:
    """An earlier version stored it. Its header is not searched for: 200,000 empty members take a second."""
    place, upload = _places(store)[0], tmp_path / "upload"
    upload.write_bytes(store.path(place).read_bytes())
    summary = SegmentSummary(place.name, store.header(place), 0, 0)
    store.path(place).write_bytes(_EMPTY + upload.read_bytes())
    assert (store.has(place), store.headers([place])) == (False, [])
    store.keep("arm1", upload, summary, 1)
    assert (store.has(place), store.headers([place])) == (True, [summary.header])
