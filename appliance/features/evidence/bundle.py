"""Make an evidence bundle: one ZIP file with the records of a period, the policies and monitors, and the proof.

1. Members are generated twice: first to hash them, then to write them. If the two differ, the export fails.
2. The manifest has the hash of every member except itself and `proof.json`, which is the audit record of the export
   with the hash of the manifest. A signed checkpoint seals that record before the first byte is sent.
3. Records are exported as they are stored, so `verify.py` computes their hashes without the appliance's code.
4. Between the first and the last record of a run, none is missing.
"""

import hashlib
import heapq
import inspect
import io
import itertools
import json
import sqlite3
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.log_queries import (
    last_of,
    last_signed,
    log_id,
    policies_of,
    record_id,
    records_of,
    sequence_of,
    sequences_in_period,
    stored_record,
)
from appliance.audit.log.signatures import pinned_key_path
from appliance.audit.proof.chain_proofs import ChainReader, stored_line
from appliance.base import clock
from appliance.channel.admin import (
    A,
    AdminAnswer,
    AdminRequest,
    MonitorRevisionWanted,
    PolicyWanted,
    Trouble,
)
from appliance.channel.answers.monitor_answers import RevisionTexts
from appliance.channel.operations import request_named
from appliance.features.evidence.page import Names, Page, RecordingSummary
from appliance.features.evidence.requests import EvidenceExported, LogSealed
from appliance.formats import bundle_verifier
from appliance.signing import log_proof
from appliance.signing.fingerprints import file_name, fingerprint, fingerprint_of_all

FORMAT = "rosrv evidence 1"
MAX_RECORDS = 1_000_000


class Ask(Protocol):
    """Ask the appliance."""

    def __call__(self, request: AdminRequest[A], /) -> AdminAnswer[A]: ...


Member = tuple[str, Iterable[bytes]]
_PAGE = 500
_APART = 1000  # a larger distance between two records begins a new run
_MOMENT = (1980, 1, 1, 0, 0, 0)  # the time of every member: the earliest that a ZIP file can store
_POLICY, _SPECIFICATIONS = "policy loaded", "specifications loaded"


def verifier_program() -> str:
    """Return `bundle_verifier.py`, with the text of `log_proof.py` instead of its import."""
    program, core = map(inspect.getsource, (bundle_verifier, log_proof))
    before, _imported, rest = program.partition("from appliance.signing.log_proof import")
    own = core.partition("from __future__ import annotations\n\n")[2]
    return before + own + "\n\n" + rest.partition("\n\n")[2]


class BundleError(Exception):
    """A bundle cannot be made; the message gives the reason, `trouble` its kind."""

    def __init__(self, text: str, trouble: Trouble) -> None:
        super().__init__(text)
        self.trouble = trouble


class TimeSpan(NamedTuple):
    """A period: from `since` (inclusive) to `until` (exclusive), in nanoseconds since the epoch."""

    since: int
    until: int


class RecordingSelection(NamedTuple):
    """A recording, by its id and the folder of all recordings."""

    id: str
    folder: Path


def export(log: Path, wanted: TimeSpan | RecordingSelection, ask: Ask, names: Names) -> Iterator[bytes]:
    """Record and seal an export, then yield the bytes of its bundle; `ask` queries the appliance.

    Raise `BundleError` or `LogUnreadableError`, even during the iteration.
    """
    recording: RecordingSummary | None = None
    bag = Path()
    if isinstance(wanted, RecordingSelection):
        recording = _recording(ask, wanted.id)
        bag = wanted.folder / wanted.id / "recording.bag"
        wanted = TimeSpan(recording.began, recording.ended + 1)
    _body(ask(LogSealed()))
    span = TimeSpan(wanted.since, min(wanted.until, clock.wall_ns()))
    bundle = _Bundle(log, span, ask, recording, bag, names)
    manifest = bundle.manifest()
    text = json.dumps(manifest, indent=1).encode() + b"\n"
    order = EvidenceExported(hashlib.sha256(text).hexdigest(), *span, bundle.count, manifest["recording"])
    proof = _proof(log, _body(ask(order)).record)
    return _zip(itertools.chain(bundle.check(manifest), [("manifest.json", [text]), ("proof.json", [proof])]))


def _recording(ask: Ask, recording_id: str) -> RecordingSummary:
    fetch: Any = request_named("recording fetch")
    if fetch is None:
        raise BundleError(
            "this appliance has no flight recorder: give --since instead of a recording", "unknown"
        )
    recording: RecordingSummary = _body(ask(fetch(recording_id)))
    return recording


class _Bundle:
    def __init__(  # noqa: PLR0917  one caller
        self, log: Path, span: TimeSpan, ask: Ask, recording: RecordingSummary | None, bag: Path, names: Names
    ) -> None:
        self._log, self._span, self._ask, self._recording, self._bag = log, span, ask, recording, bag
        self._names = names
        with reading(log) as connection:
            connection.execute("BEGIN")
            self._find(connection)
        self.count = sum(last - first + 1 for first, last in self._runs)

    def _find(self, log: sqlite3.Connection) -> None:
        self._id = log_id(log)
        _number, sealed = last_signed(log)
        sequences = sequences_in_period(log, *self._span, upto=sealed, limit=MAX_RECORDS + 1)
        self._runs = _runs(sequences)
        if not sequences:
            raise BundleError(
                "the log has no record in that period: give another one (rosrv audit search --since)",
                "unknown",
            )
        if len(sequences) > MAX_RECORDS:
            raise BundleError(f"more than {MAX_RECORDS} records match: export a shorter period", "request")
        begin = self._runs[0][0]
        loads = {last_of(log, event, begin) for event in (_POLICY, _SPECIFICATIONS)}
        self._policies: set[int] = set()
        for first, last in self._runs:
            beside = min(last + 1, sealed)  # the verifier also reads the records next to a run
            for event in (_POLICY, _SPECIFICATIONS):
                loads |= {row.sequence for row in records_of(log, event, after=first - 2, upto=beside)}
            for revision in policies_of(log, first, last):
                self._policies.add(revision)
                loads.add(last_of(log, _POLICY, last + 1, revision))
        alone = {sequence for sequence in loads if sequence is not None}
        self._specifications: set[int] = set()
        self._hashes: dict[str, str | None] = {}  # of the texts: revisions of another state have other texts
        for load in filter(None, (stored_record(log, sequence) for sequence in sorted(alone))):
            detail = json.loads(load.detail)
            if load.event == _SPECIFICATIONS:
                revision = detail["revision_of_specifications"]
                self._specifications.add(revision)
                self._hashes[f"specifications/{revision}/"] = detail.get("sha256")
            elif load.revision is not None:
                self._policies.add(load.revision)
                self._hashes[f"policies/{load.revision}.ini"] = detail.get("sha256")
        if self._recording is not None:
            alone |= {
                row.sequence
                for row in records_of(log, "recording closed", upto=sealed)
                if json.loads(row.detail).get("recording") == self._recording.id
            }
        edges = {edge for first, last in self._runs for edge in (first - 1, last + 1) if edge <= sealed}
        self._alone = sorted(alone | {edge for edge in edges if record_id(log, edge) is not None})

    def manifest(self) -> dict[str, Any]:
        manifest: dict[str, Any] = {
            "format": FORMAT, "log": self._id, "since": self._span.since, "until": self._span.until,
            "recording": self._recording.id if self._recording else "", "runs": self._runs, "missing": [],
            "members": {},
        }  # fmt: skip
        for name, pieces in self.members(manifest):
            digest, size = hashlib.sha256(), 0
            for piece in pieces:
                digest.update(piece)
                size += len(piece)
            manifest["members"][name] = {"sha256": digest.hexdigest(), "bytes": size}
        return manifest

    def check(self, manifest: dict[str, Any]) -> Iterator[Member]:
        left = dict(manifest["members"])
        for name, pieces in self.members({**manifest, "missing": [*manifest["missing"]]}):
            digest = hashlib.sha256()
            yield name, _note_each(pieces, digest.update)
            if left.pop(name, {}).get("sha256") != digest.hexdigest():
                raise BundleError(f"{name} changed during the export: export again", "failed")
        if left:
            raise BundleError(f"{', '.join(left)} disappeared during the export: export again", "failed")

    def members(self, manifest: dict[str, Any]) -> Iterator[Member]:
        yield "verify.py", [verifier_program().encode()]
        yield "audit.pub", [pinned_key_path(self._log).read_bytes()]
        for revision in sorted(self._policies):
            place = f"policies/{revision}.ini"
            policy = self._text(
                PolicyWanted(revision), place, manifest, lambda found: fingerprint(found.text)
            )
            if policy is not None:
                yield place, [policy.text.encode()]
                yield from _signatures({place: policy.signature})
        for revision in sorted(self._specifications):
            place = f"specifications/{revision}/"
            texts = self._text(
                MonitorRevisionWanted(revision),
                place,
                manifest,
                lambda found: fingerprint_of_all(_named(found)),
            )
            if texts is not None:
                yield from (
                    (place + file_name(name), [text.encode()]) for name, text in sorted(_named(texts).items())
                )
                yield from _signatures(
                    {
                        place + file_name(name if name in texts.files else f"msg/{name}"): signature
                        for name, signature in sorted(texts.signatures.items())
                    }
                )
        if self._recording is not None:
            about = msgspec.json.format(msgspec.json.encode(self._recording), indent=1) + b"\n"
            yield "recording/recording.json", [about]
            yield "recording/recording.bag", _file(self._bag)
        page = Page(self._recording, self._names)
        within = itertools.chain.from_iterable(range(first, last + 1) for first, last in self._runs)
        yield "records.ndjson", _note_each(_records(self._log, heapq.merge(self._alone, within)), page.add)
        yield "index.html", (page.html(manifest) for _once in "1")

    def _text(
        self, request: AdminRequest[A], place: str, manifest: dict[str, Any], hash_of: Callable[[A], str]
    ) -> A | None:
        if place in manifest["missing"]:
            return None
        answer: AdminAnswer[A] = self._ask(request)
        wanted = self._hashes.pop(place, None)  # the second time, a text is compared with the first
        if answer.trouble == "unknown" or (wanted is not None and hash_of(_body(answer)) != wanted):
            manifest["missing"].append(place)
            return None
        return _body(answer)


def _body(answer: AdminAnswer[A]) -> A:
    if not answer.ok:
        raise BundleError(answer.error, answer.trouble)
    return answer.unwrap()


def _named(texts: RevisionTexts) -> dict[str, str]:
    return {**texts.files, **{f"msg/{name}": text for name, text in texts.definitions.items()}}


def _runs(sequences: list[int]) -> list[tuple[int, int]]:
    """Return the first and last sequence of each run. A gap of more than `_APART` begins a new run."""
    runs: list[tuple[int, int]] = []
    for sequence in sequences:
        if runs and sequence - runs[-1][1] <= _APART:
            runs[-1] = runs[-1][0], sequence
        else:
            runs.append((sequence, sequence))
    return runs


def _file(path: Path) -> Iterator[bytes]:
    try:
        with path.open("rb") as file:
            while piece := file.read(1 << 20):
                yield piece
    except OSError as error:
        raise BundleError(f"{path}: {error.strerror}", "failed") from error


def _signatures(signatures: dict[str, str]) -> Iterator[Member]:
    return ((f"signatures/{name}.sig", [text.encode()]) for name, text in signatures.items() if text)


def _note_each(pieces: Iterable[bytes], note: Callable[[bytes], object]) -> Iterator[bytes]:
    for piece in pieces:
        note(piece)
        yield piece


def _records(log: Path, sequences: Iterable[int]) -> Iterator[bytes]:
    unique = (sequence for sequence, _same in itertools.groupby(sequences))
    pairs = itertools.pairwise(itertools.chain(unique, [0]))
    while page := list(itertools.islice(pairs, _PAGE)):
        with reading(log) as connection:
            connection.execute("BEGIN")
            places = ChainReader(connection)
            lines = [_line(connection, places, *pair) for pair in page]
        yield b"".join(lines)


def _line(connection: sqlite3.Connection, places: ChainReader, sequence: int, following: int) -> bytes:
    row = stored_record(connection, sequence)
    chain = places.place(sequence, following)
    if row is None or chain is None:
        raise LogUnreadableError(
            f"record {sequence} was removed by retention during the export: export again"
        )
    return stored_line(row, chain)


def _proof(log: Path, record: str) -> bytes:
    with reading(log) as connection:
        sequence = sequence_of(connection, record)
    if sequence is None:
        raise LogUnreadableError(f"{log}: has no record {record} of this export; run 'rosrv audit verify'")
    return b"".join(_records(log, [sequence]))


class _Pipe(io.RawIOBase):
    """A buffer for the ZIP writer; `take` empties it."""

    def __init__(self) -> None:
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._held += data
        return len(data)

    def take(self) -> bytes:
        taken = bytes(self._held)
        self._held.clear()
        return taken


def _zip(members: Iterable[Member]) -> Iterator[bytes]:
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w") as archive:
        for name, pieces in members:
            about = zipfile.ZipInfo(name, _MOMENT)
            about.external_attr = 0o644 << 16
            about.compress_type = zipfile.ZIP_STORED if name.endswith(".bag") else zipfile.ZIP_DEFLATED
            with archive.open(about, "w", force_zip64=True) as member:
                for piece in pieces:
                    member.write(piece)
                    yield pipe.take()
    yield pipe.take()
