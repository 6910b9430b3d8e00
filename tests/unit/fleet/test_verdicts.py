"""Verifiers agree: each attack on a log, its segments or its evidence has the verdicts that verdicts.txt lists.

The log is verified alone, with the signer's memory, and with copies of its checkpoints. The segment reader and the
collector's store verify its second segment, and the bundle's program verifies evidence of records 3 and 12 to 22.
"""

import gzip
import hashlib
import io
import itertools
import json
import lzma
import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.verification import prove

from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import COLUMNS, reading
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.signatures import read_public_key, signature_is_valid
from appliance.audit.proof.chain_proofs import ChainReader, stored_line
from appliance.audit.proof.copies import SignedCheckpoint, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.base import clock
from appliance.formats.bundle_verifier import FORMAT, Verifier
from appliance.formats.segments import SegmentError, SegmentReader, write_segment
from appliance.ipsec.signed_checkpoints import CheckpointMemory
from appliance.signing.log_proof import Removal
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.support.forgery import write_anew
from tests.support.virtual_clock import VirtualClock
from tests.unit.transcripts import transcripts

# ruff: noqa: S608  the statements are built from names of columns

FILE = Path(__file__).with_name("verdicts.txt")
CASES = transcripts(FILE)
OLD = Path(__file__).parents[1] / "audit/proof/log-0.1.0.db.xz"
_RUN, _ALONE, _EVERY, _LARGEST = (12, 22), 3, 10, 1 << 20
_LONG = re.compile("(?i)[0-9a-f]{32,}")
Lines = list[bytes]


class Site(NamedTuple):
    log: Path
    key: Ed25519PrivateKey
    copies: list[SignedCheckpoint]
    segments: list[Lines]
    evidence: dict[str, Lines]

    @property
    def public(self) -> bytes:
        return self.key.public_key().public_bytes_raw()

    @property
    def memory(self) -> Path:
        return self.log.with_name("memory")


def made(folder: Path, seed: int) -> Site:
    key = Ed25519PrivateKey.from_private_bytes(bytes([seed]) * 32)
    (folder / "memory").mkdir(parents=True)
    signer, asked, path = CheckpointMemory(folder / "memory", clock.wall_ns), [], folder / "audit.db"
    log = AuditLog(path, drive=ByHand, checkpoint_every=_EVERY, signer=lambda *one, **_: asked.append(one))

    def add(count: int, **fields: Any) -> None:
        for number in range(count):
            log.record(decision(log, number, reason="é\x1b", **fields))
            assert settle(log) is None
            for checkpoint, text in asked:
                signer.accept(text)
                log.store_signature(checkpoint, key.sign(text), key.public_key().public_bytes_raw())
            asked.clear()

    add(45)
    records = stored(path, [_ALONE, *range(_RUN[0] - 1, _RUN[1] + 2)])
    members = {"audit.pub": path.with_name("audit.pub").read_bytes(), "records.ndjson": b"".join(records)}
    manifest = json.dumps({
        "format": FORMAT, "log": signed_checkpoints(path)[0].log, "since": 0, "until": 1, "recording": "",
        "runs": [_RUN], "missing": [],
        "members": {name: {"sha256": hashlib.sha256(data).hexdigest()} for name, data in members.items()},
    }).encode()  # fmt: skip
    (sequence,) = found(path, "SELECT max(sequence) + 1 FROM record")[0]
    add(1, event="evidence exported", detail={"manifest": hashlib.sha256(manifest).hexdigest()})
    add(2 * _EVERY)
    log.close()
    numbers = (number for number in itertools.count(1))
    evidence = {name: [data] for name, data in members.items()} | {
        "manifest.json": [manifest], "proof.json": stored(path, [sequence]), "records.ndjson": records,
    }  # fmt: skip
    return Site(
        path, key, signed_checkpoints(path), list(iter(lambda: segment(path, next(numbers)), [])), evidence
    )


def found(path: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def stored(path: Path, sequences: list[int]) -> Lines:
    with reading(path) as connection:
        places, lines = ChainReader(connection), Lines()
        for sequence, following in itertools.pairwise([*sequences, 0]):
            query = f"SELECT {COLUMNS} FROM record WHERE sequence = ?"
            columns, place = (
                connection.execute(query, (sequence,)).fetchone(),
                places.place(sequence, following),
            )
            assert place is not None
            lines.append(stored_line(StoredColumns(*columns), place))
    return lines


def segment(path: Path, number: int) -> Lines:
    lines = Lines()
    write_segment(path, number, lines.append)
    return lines


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> tuple[Site, Site]:
    folder = tmp_path_factory.mktemp("sites")
    with clock.using(VirtualClock(wall=1_800_000_000)):
        return made(folder / "own", 1), made(folder / "other", 2)


# --- attacks ------------------------------------------------------------------------------------------------------


def edited(line: bytes, **fields: object) -> bytes:
    return json.dumps(json.loads(line) | fields, separators=(",", ":")).encode() + b"\n"


def checkpoints(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Lines, Lines], Lines]:
    def changed(value: Any, number: int) -> Any:
        if isinstance(value, dict):
            inner = {name: changed(one, number) for name, one in value.items()}
            return change(inner) if value.get("number") == number and "signature" in value else inner
        return value

    def attack(lines: Lines, _other: Lines) -> Lines:
        last = max(int(number) for number in re.findall(rb'"number":(\d+),"sequence"', b"".join(lines)))
        return [edited(line, **changed(json.loads(line), last)) for line in lines]

    return attack


def chain(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Lines, Lines], Lines]:
    def attack(lines: Lines, _other: Lines) -> Lines:
        return [*lines[:4], edited(lines[4], chain=change(json.loads(lines[4])["chain"])), *lines[5:]]

    return attack


def signed_anew(seed: int, *, own_key: bool, **fields: object) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def change(checkpoint: dict[str, Any]) -> dict[str, Any]:
        key = Ed25519PrivateKey.from_private_bytes(bytes([seed]) * 32)
        new = SignedCheckpoint(**checkpoint | fields)
        shown = {"key": key.public_key().public_bytes_raw().hex()} if own_key else {}
        return checkpoint | fields | {"signature": key.sign(new.text()).hex()} | shown

    return change


LINES: dict[str, Callable[[Lines, Lines], Lines]] = {
    "nothing": lambda lines, _other: lines,
    "cut the last line": lambda lines, _other: lines[:-1],
    "cut half of the last line": lambda lines, _other: [*lines[:-1], lines[-1][:-60]],
    "cut all but the first line": lambda lines, _other: lines[:1],
    "cut everything": lambda _lines, _other: [],
    "remove a line": lambda lines, _other: [*lines[:4], *lines[5:]],
    "repeat a line": lambda lines, _other: [*lines[:4], lines[4], *lines[4:]],
    "swap two lines": lambda lines, _other: [*lines[:4], lines[5], lines[4], *lines[6:]],
    "edit a host": lambda lines, _other: [*lines[:4], edited(lines[4], host="10.9.9.9"), *lines[5:]],
    "edit a sequence": lambda lines, _other: [*lines[:4], edited(lines[4], sequence=99), *lines[5:]],
    "add a field": lambda lines, _other: [*lines[:4], edited(lines[4], more=1), *lines[5:]],
    "repeat a field": lambda lines, _other: [
        *lines[:4], lines[4].replace(b'"revision":3,', b'"revision":3,"revision":3,', 1), *lines[5:]
    ],
    "add a space to the first line": lambda lines, _other: [lines[0].replace(b":", b": ", 1), *lines[1:]],
    "name another version": lambda lines, _other: [lines[0].replace(b'"segment":1', b'"segment":2'), *lines[1:]],
    "remove what comes before": lambda lines, _other: [edited(lines[0], begin=None, after=None), *lines[1:]],
    "add a deep line": lambda lines, _other: [*lines, b"[" * 100_000 + b"\n"],
    "add a space": lambda lines, _other: [*lines[:4], lines[4].replace(b":", b": ", 1), *lines[5:]],
    "add a line of another log": lambda lines, other: [*lines, other[-1]],
    "take a line of another log": lambda lines, other: [*lines[:4], other[4], *lines[5:]],
    "take all but the first line of another log": lambda lines, other: [lines[0], *other[1:]],
    "take everything of another log": lambda _lines, other: other,
    "edit a previous hash": chain(lambda chain: chain | {"previous": "0" * 64}),
    "edit a hash": chain(lambda chain: chain | {"hash": "0" * 64}),
    "spell a hash in capitals": chain(lambda chain: chain | {"hash": chain["hash"].upper()}),
    "insert a hash": chain(lambda chain: chain | {"then": ["0" * 64, *chain["then"]]}),
    "claim a log of version 0.1.0": chain(lambda chain: chain | {"then": None}),
    "remove the checkpoint": checkpoints(lambda _checkpoint: {}),
    "edit the checkpoint's time": checkpoints(lambda one: one | {"time": 1}),
    "edit the checkpoint's hash": checkpoints(lambda one: one | {"hash": "0" * 64}),
    "spell the checkpoint's number as a text": checkpoints(lambda one: one | {"number": str(one["number"])}),
    "spell the checkpoint's number as a fraction": checkpoints(lambda one: one | {"number": one["number"] + 0.0}),
    "add a field to the checkpoint": checkpoints(lambda one: one | {"more": 1}),
    "spell the signature in capitals": checkpoints(lambda one: one | {"signature": one["signature"].upper()}),
    "cut the signature": checkpoints(lambda one: one | {"signature": one["signature"][:-2]}),
    "sign with another key": checkpoints(signed_anew(2, own_key=False)),
    "sign with another key, and name it": checkpoints(signed_anew(2, own_key=True)),
    "forge a hash with the own key": checkpoints(signed_anew(1, own_key=True, hash="0" * 64)),
    "forge a log with the own key": checkpoints(signed_anew(1, own_key=True, log="0" * 32)),
    "forge a number with the own key": checkpoints(signed_anew(1, own_key=True, number=9)),
    "forge a predecessor with the own key": checkpoints(signed_anew(1, own_key=True, previous="0" * 64)),
    "forge a sequence with the own key": checkpoints(signed_anew(1, own_key=True, sequence=20)),
    "forge a time with the own key": checkpoints(signed_anew(1, own_key=True, time=1)),
}  # fmt: skip


def _proof(key: Ed25519PrivateKey, said: Removal) -> dict[str, object]:
    return {"limit": said.limit, "signature": key.sign(said.text()).hex()}


REMOVALS: dict[str, Callable[[Site, Removal], dict[str, object]]] = {
    "signed": lambda site, said: _proof(site.key, said),
    "unsigned": lambda _site, _said: {},
    "signed with another key": lambda _site, said: _proof(Ed25519PrivateKey.generate(), said),
    "signed for another checkpoint": lambda site, said: _proof(site.key, said._replace(checkpoint=9)),
    "signed for another log": lambda site, said: _proof(site.key, said._replace(log="0" * 32)),
    "signed for another limit": lambda site, said: _proof(site.key, said) | {"limit": "1 days"},
}


def remove(site: Site, log: Path, proof: Callable[[Site, Removal], dict[str, object]]) -> None:
    writer = ChainWriter(log, 0)
    gone = writer.removable(1, signed=True)
    assert gone is not None
    about = writer.log_id, gone.last_checkpoint, gone.last_sequence, gone.last_hash, gone.last_checkpoint_hash
    detail = msgspec.to_builtins(gone) | {"count": 1} | proof(site, Removal(*about, "30.0 days"))
    writer.remove(gone, AuditRecord(id="f" * 20, time=1, event="records removed", detail=detail))
    writer.close()


STORES: dict[str, Callable[[Site, Site], dict[int, Lines]]] = {
    "nothing": lambda _own, _other: {},
    "remove the first": lambda _own, _other: {1: []},
    "remove the second": lambda _own, _other: {2: []},
    "remove the last": lambda own, _other: {len(own.segments): []},
    "take a segment of another log": lambda _own, other: {2: other.segments[1]},
    "swap two": lambda own, _other: {2: own.segments[2], 3: own.segments[1]},
    "take one twice": lambda own, _other: {2: own.segments[0]},
    "edit a host": lambda own, other: {2: LINES["edit a host"](own.segments[1], other.segments[1])},
    "take one of another time": lambda own, _other: {
        2: LINES["forge a time with the own key"](own.segments[1], [])
    },
}


def rewritten(site: Site, log: Path) -> None:
    write_anew(log, site.key, log.with_name("rewritten"), "UPDATE record SET host = 'x' WHERE sequence = 15")


# --- verdicts -----------------------------------------------------------------------------------------------------


def of_log(log: Path, key: bytes, *elsewhere: Any) -> Iterator[str]:
    alone, full = (verify(log, key, *more) for more in ((), elsewhere))
    yield f"signed through {alone.signed_through} of {alone.last}, removal: {alone.removal}"
    yield from (f"alone: {finding.kind}: {finding.message}" for finding in alone.findings)
    yield from (f"elsewhere: {one.kind}: {one.message}" for one in full.findings if one not in alone.findings)


def of_segment(site: Site, lines: Lines) -> Iterator[str]:
    try:
        SegmentReader(io.BytesIO(b"".join(lines)), (site.public,), _LARGEST).summary()
    except SegmentError as error:
        yield f"segment: {error}"
    else:
        yield "segment: valid"


def of_store(site: Site, folder: Path, changes: dict[int, Lines], further: Lines = []) -> Iterator[str]:  # noqa: B006  never changed
    store = SegmentStore(folder, 0)
    for number, lines in enumerate([*site.segments, *([further] if further else [])], 1):
        upload = folder / f"{number}.gz"
        upload.write_bytes(gzip.compress(b"".join(lines), mtime=0))
        summary = SegmentReader(io.BytesIO(b"".join(lines)), (site.public,), _LARGEST).summary()
        file = store.path(store.keep("arm1", upload, summary, 1))
        if changes.get(number):
            file.write_bytes(gzip.compress(b"".join(changes[number])))
        elif number in changes:
            file.unlink()
    robot = Robot(name="arm1", key=site.public.hex(), certificate="", added=0)
    for proof in prove(store, robot, _LARGEST):
        yield f"collector: {proof.segments} segments, {proof.records} records, {proof.missing} missing"
        yield from (f"collector: {finding}".replace(f"{folder}/", "") for finding in proof.findings)


class InProcess(Verifier):
    """The bundle's verifier without `openssl`, as on a collector."""

    def __init__(self, bundle: Path, key: bytes, copies: dict[tuple[str, int], list[dict[str, Any]]]) -> None:
        self._key = key
        super().__init__(bundle, None, Path(), copies)

    def read_key(self, _key: Path | None) -> str:
        return self._key.hex()

    def has_signed(self, key: bytes, signature: bytes, text: bytes) -> bool:
        return signature_is_valid(key, signature, text)


def of_evidence(site: Site, folder: Path, lines: Lines, copies: list[SignedCheckpoint]) -> Iterator[str]:
    for name, parts in ({**site.evidence, "records.ndjson": lines}).items():
        (folder / name).write_bytes(b"".join(parts))
    kept = {(copy.log, copy.number): [json.loads(copy.as_json())] for copy in copies}
    verifier = InProcess(folder, site.public, kept)
    verifier.run()
    yield f"evidence: {verifier.checkpoints} checkpoints, {verifier.agreeing} kept elsewhere"
    usual = ("'records.ndjson': was changed", "the specifications in force: ", "policies/3.ini: ")
    yield from (f"evidence: {one}" for one in verifier.findings + verifier.notes if not one.startswith(usual))


def verdicts(action: str, folder: Path, own: Site, other: Site) -> Iterator[str]:
    kind, name = action.split(": ", 1)
    log = Path(shutil.copytree(own.log.parent, folder / "log")) / own.log.name
    if kind == "sql":
        for statement in name.split("; "):
            attack(log, statement.replace("OTHER_COLUMNS", COLUMNS.split(", ", 1)[1]))
        yield from of_log(log, own.public, own.memory, own.copies)
    elif kind == "old":
        log.write_bytes(lzma.decompress(OLD.read_bytes()))
        attack(log, name)
        yield from of_log(log, read_public_key(OLD.with_name("log-0.1.0.pub")))
    elif kind == "removal":
        remove(own, log, REMOVALS[name])
        yield from of_log(log, own.public, own.memory, own.copies)
    elif kind == "history":
        rewritten(own, log)
        yield from of_log(log, own.public, own.memory, own.copies)
        yield from of_store(own, folder / "store", {}, segment(log, 2))
    elif kind == "store":
        yield from of_store(own, folder / "store", STORES[name](own, other))
    elif kind == "lines":
        changed = LINES[name](own.segments[1], other.segments[1])
        yield from of_segment(own, changed)
        (folder / "evidence").mkdir()
        records = LINES[name](own.evidence["records.ndjson"], other.evidence["records.ndjson"])
        yield from of_evidence(own, folder / "evidence", records, own.copies)
    else:
        raise ValueError(kind)


def attack(log: Path, statement: str) -> None:
    with closing(sqlite3.connect(log)) as connection:
        connection.execute(statement)
        connection.commit()


@pytest.mark.parametrize("title", CASES, ids=CASES)
def test_verdict(title: str, sites: tuple[Site, Site], tmp_path: Path) -> None:
    """With `TRANSCRIPTS=write`, the test writes the verdicts to the file."""
    written, took_place = CASES[title], list[str]()
    actions = [line for line in written if not line.startswith(" ")]
    assert actions
    for number, action in enumerate(actions):
        (tmp_path / str(number)).mkdir()
        took_place.append(action)
        for verdict in verdicts(action, tmp_path / str(number), *sites):
            took_place.append(f"    {_LONG.sub('HEX', verdict)}")
    if took_place != written and os.environ.get("TRANSCRIPTS") == "write":
        text = FILE.read_text(encoding="utf-8")
        old, new = ("\n".join([f"# {title}", *lines, ""]) for lines in (written, took_place))
        FILE.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert took_place == written
