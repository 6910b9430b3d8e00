#!/usr/bin/env python3
"""Verify an evidence bundle of a ROSRV appliance with the appliance's signatures, and list all differences.

    python3 verify.py [BUNDLE.zip, or its folder] [--key audit.pub] [--checkpoints copies.ndjson]

This program needs Python 3.8 or newer and the command `openssl` (3.0 or newer). Exit status 0: valid; 1: not valid; 2:
not a bundle.

1. manifest.json has the SHA-256 of every other member except proof.json. The bundle has no further members, and a ZIP
   file has no bytes outside the members except those that the format requires.
2. proof.json is the audit record of this export, and has the SHA-256 of manifest.json.
3. Every audit record has the hash of the record before it, up to a checkpoint that the appliance's key signed. A run of
   records is complete, and the records next to it are outside the time of the bundle.
4. Policies, specifications and the recording have the hashes that are stored in the log.

Every check depends on the key: use --key with a copy that was kept elsewhere. Root on the appliance can sign anything;
checkpoints that another machine received earlier (--checkpoints) reveal a rewritten log. A bundle can contain a changed
copy of this program: take the program from an appliance (`rosrv evidence verifier`).
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
    del sys.path[0]  # the folder of this file, which may contain a foreign json.py

import argparse
import hashlib
import json
import os
import stat
import struct
import subprocess
import tempfile
import zipfile
import zlib
from bisect import bisect_left
from collections import Counter, defaultdict
from pathlib import Path
from typing import IO, Any, Callable, Iterator

from appliance.signing.log_proof import (
    Checkpoint,
    Excerpt,
    ProofFault,
    parse_checkpoint,
    sha256,
    signature_fault,
)

FORMAT = "rosrv evidence 1"
FIELDS = {"format", "log", "since", "until", "recording", "runs", "missing", "members"}
OWN = ("manifest.json", "proof.json")
COLUMNS = (
    "sequence", "id", "time", "version", "event", "severity", "decision", "host", "caller_id", "category", "resource",
    "rule", "rule_key", "rule_file", "rule_line", "revision", "reason", "duration_us",
)  # fmt: skip
MAX = 16 << 20  # bytes of a member that is read in one piece, or of a line
# The members of a ZIP file may unpack to UNPACKED bytes plus PER_BYTE for each byte of the file. Records have hashes,
# which cannot be compressed: even with the longest texts they shrink to no less than 1/256.
UNPACKED, PER_BYTE = 1 << 30, 256
CHAIN = {"previous", "hash", "then", "checkpoint"}
# Parts of a ZIP file: an entry of the directory, the header of a member, the end. FREE: the appliance's values of the
# fields that a packer may choose.
ENTRY, HEADER, END = map(struct.Struct, ("<4s4B4H3L5H2L", "<4s2B4H3L2H", "<4s4H2LH"))
FREE, LARGE = (3, 0, 0, 33, 0, 0, 0o644 << 16), 0xFFFFFFFF
Opener = Callable[[str], IO[bytes]]


def printable(text: str) -> str:
    """Escape unprintable characters: a bundle may have any text in place of a number."""
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def unhex(text: str) -> bytes:
    data = bytes.fromhex(text)
    if data.hex() != text:
        raise ValueError(f"{text[:80]!a} is not a valid hash")
    return data


def pack(value: bytes | str | int | None) -> bytes:
    if value is None:
        return b"\xc0"
    if isinstance(value, int):
        if -32 <= value < 128:
            return value.to_bytes(1, "big", signed=True)
        power = next(power for power in range(4) if -1 << (8 << power) - 1 <= value < 1 << (8 << power))
        kind = 0xCC if value > 0 else 0xD0
        return bytes([kind + power]) + value.to_bytes(1 << power, "big", signed=value < 0)
    data: bytes = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    if data is not value and len(data) < 32:
        return bytes([0xA0 + len(data)]) + data
    power = next(power for power in range(3) if len(data) < 1 << (8 << power))
    return bytes([(0xC4 if data is value else 0xD9) + power]) + len(data).to_bytes(1 << power, "big") + data


def extra(*sizes: int) -> bytes:
    return struct.pack(f"<2H{len(sizes)}Q", 1, 8 * len(sizes), *sizes)


def ends(file: IO[bytes], size: int, unpacked: int) -> bool:
    """Return whether the compressed data that begins here has `size` bytes, with zeros in the unused bits of the last
    byte.

    Reading stops after `unpacked` bytes.
    """
    unpacker = zlib.decompressobj(-15)
    while size > 1 and not unpacker.eof and unpacked >= 0:
        piece = file.read(min(size - 1, 4096))
        unpacked -= len(unpacker.decompress(piece))
        size -= len(piece) or size
    last, other = file.read(1)[0], unpacker.copy()
    text = unpacker.decompress(bytes([last]))
    spare = last and other.decompress(bytes([last ^ 1 << last.bit_length() - 1])) == text and other.eof
    return size == 1 and unpacker.eof and not unpacker.unused_data and not spare


def foreign(archive: zipfile.ZipFile) -> Iterator[str]:
    """Yield a finding for bytes of a ZIP file outside its members, and "" if another program packed it."""
    file = archive.fp
    assert file is not None  # noqa: S101  it is open
    file.seek(archive.start_dir)
    directory, at, begin, members = file.read(MAX), 0, 0, archive.infolist()
    free: set[object] = {FREE}  # the fields that each packer chooses
    for info in members:
        name, where, packed, size = info.filename, info.header_offset, info.compress_size, info.file_size
        entry = ENTRY.unpack_from(directory, begin)
        text = directory[begin + ENTRY.size :][: entry[12]]
        begin += ENTRY.size + sum(entry[12:15])
        usual = {*entry[1:4:2]} <= {20, 45} and not entry[5] & ~0x808
        free.add(usual and (*entry[2:5:2], *entry[7:9], *entry[15:18]))
        if where != at:
            yield f"bytes {at} to {where}: belong to no member"
        large = (b"", extra(size, packed), extra(where), extra(size, packed, where))
        if info.comment or info.extra not in large:
            yield f"{name!a}: has a comment or an extra field"
        file.seek(where)
        header = HEADER.unpack(file.read(HEADER.size))
        name_here = file.read(header[10])
        told = (0, 0, 0) if info.flag_bits & 8 else (info.CRC, packed, size)
        same = (
            header[0] == b"PK\3\4" and header[1] in (20, entry[3]) and header[2:8] == (*entry[4:9], told[0])
        )
        if not same or header[8:10] not in (told[1:], (LARGE, LARGE)) or name_here != text:
            yield f"{name!a}: its header differs from the directory's"
        if file.read(header[11]) not in (b"", extra(0, 0), extra(size, packed)):
            yield f"{name!a}: has an extra field"
        at = file.tell() + packed
        if not (ends(file, packed, size) if info.compress_type else packed == size):
            yield f"{name!a}: extra bytes follow it"
        file.seek(at)
        forms = ("<4sLQQ", "<4s3L") if max(packed, size) < LARGE else ("<4sLQQ",)
        sealed, after = (
            [struct.pack(form, b"PK\7\x08", info.CRC, packed, size) for form in forms],
            file.read(24),
        )
        at += next((len(seal) for seal in sealed if after.startswith(seal)), 0) if info.flag_bits & 8 else 0
    start, count = archive.start_dir, len(members)
    if at != start:
        yield f"bytes {at} to {start}: belong to no member"
    few = min(count, 0xFFFF)
    end = END.pack(b"PK\5\6", 0, 0, few, few, min(begin, LARGE), min(start, LARGE), 0)
    much = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, begin, start)
    if directory[begin:] not in (end, much + struct.pack("<4sLQL", b"PK\6\7", 0, start + begin, 1) + end):
        yield f"bytes {start + begin} to the end: are not the end of this ZIP file"
    if free != {FREE}:
        yield ""


def regular(path: Path, follow: bool = True) -> IO[bytes]:
    """Open a regular file. Raise OSError for pipes and devices, which could block their reader forever."""
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
    descriptor = os.open(path, flags | (0 if follow else getattr(os, "O_NOFOLLOW", 0)))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(22, "is not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def require_bounded(archive: zipfile.ZipFile, size: int) -> None:
    """Raise ValueError for a ZIP file whose members overlap, or unpack to more than a bundle of its size can."""
    members, most = archive.infolist(), UNPACKED + PER_BYTE * size
    if sum(info.compress_size for info in members) > size:
        raise ValueError("its members overlap: it is not a bundle")
    if sum(info.file_size for info in members) > most:
        raise ValueError(f"it unpacks to more than {most} bytes: too large for a bundle of its size")


def open_bundle(place: Path) -> tuple[list[str], Opener, Iterator[str]]:
    if not place.is_dir():
        with regular(place) as file:
            size = os.fstat(file.fileno()).st_size
        archive = zipfile.ZipFile(place)
        require_bounded(archive, size)
        return archive.namelist(), archive.open, foreign(archive)
    paths = [path for path in place.rglob("*") if path.is_symlink() or not path.is_dir()]
    strange = {path: "" if path.is_file() and not path.is_symlink() else " (no file)" for path in paths}
    names = [path.relative_to(place).as_posix() + strange[path] for path in paths]
    return names, lambda name: regular(place / name, follow=False), iter(())


class Runs:
    """The runs of records in a bundle, in ascending order."""

    def __init__(self, pairs: list[list[int]]) -> None:
        edges = [-1, *(edge for first, last in pairs for edge in (first, last))]
        # At least one record is between two runs.
        steps = (here - before for before, here in zip(edges, edges[1:]))  # noqa: RUF007  Python 3.8
        if any(step < (2, 0)[number % 2] for number, step in enumerate(steps)):
            raise ValueError("the runs of manifest.json are not in order")
        self.first, self.last = [first for first, _last in pairs], [last for _first, last in pairs]
        self.missing = sum(last - first + 1 for first, last in pairs)
        self.beside = {edge: False for first, last in pairs for edge in (first - 1, last + 1)}

    def meet(self, first: int, last: int) -> bool:
        after = bisect_left(self.last, first)
        return after < len(self.last) and self.first[after] <= last


CHANGED = "the bundle was changed after the export"
UNSIGNED = "it is not signed with this key: the key is of another appliance, or the bundle was made again"
REWRITTEN = "a checkpoint differs from the one kept elsewhere: the log was rewritten, or the kept one was"
FOREIGN = "the checkpoints kept elsewhere are of other logs, so they prove nothing about this one"


class Verifier:
    """The verification of a bundle: its faults (`findings`), and the claims that it does not prove (`notes`)."""

    def __init__(
        self, path: Path, key: Path | None, folder: Path, copies: dict[tuple[str, int], list[dict[str, Any]]]
    ) -> None:
        self.names, self.open, self.foreign = open_bundle(path)
        self.key, self.copies = folder / "key", copies
        self.raw_key = self.read_key(key)
        self.findings: list[str] = []
        self.notes: list[str] = []
        self.manifest: dict[str, Any] = {}
        self.sums: dict[str, str] = {}  # of the members
        self.loads: dict[str, str | None] = {}  # the hash in the log of each loaded file or folder
        self.revisions: set[int | None] = set()  # revisions of the policies that decided
        self.causes: dict[str, str] = {}  # of findings about something else than a change of the bundle
        self.checkpoints = self.signed = self.agreeing = 0

    def read_key(self, key: Path | None) -> str:
        with regular(key) if key else self.open("audit.pub") as file:
            self.key.write_bytes(file.read(MAX))
        order = ["openssl", "pkey", "-pubin", "-outform", "DER", "-in", str(self.key)]
        return subprocess.run(order, check=True, capture_output=True).stdout[-32:].hex()

    def run(self) -> None:
        looks = {
            "the ZIP file": self.look_beside, "manifest.json": self.look_at_members, "proof.json": self.look_at_proof,
            "records.ndjson": self.look_at_records, "the hashes in the log": self.look_at_texts,
        }  # fmt: skip
        for what, look in looks.items():
            try:
                look()
            except Exception as error:  # the file may contain anything
                self.findings.append(f"{what}: cannot be read: {type(error).__name__} {error}")

    def verdict(self) -> str:
        if not self.findings:
            return "valid: the bundle is unchanged since the appliance sealed it"
        causes = {self.causes.get(finding, CHANGED) for finding in self.findings}
        if CHANGED in causes or (UNSIGNED in causes and self.signed):
            return f"invalid: {CHANGED}"
        return f"invalid: {'; '.join(sorted(causes))}"

    def blame(self, cause: str, finding: str) -> None:
        self.findings.append(finding)
        self.causes[finding] = cause

    def read(self, name: str) -> bytes:
        with self.open(name) as file:
            data = bytes(file.read(MAX + 1))
        if len(data) > MAX:
            raise ValueError(f"{name} has more than {MAX} bytes")
        return data

    def look_beside(self) -> None:
        """Check rule 1: no bytes outside the members."""
        for found in self.foreign:
            self.findings += [f"the ZIP file: {found}"] if found else []
            self.notes += [] if found else ["times and attributes in the ZIP file: another program packed it"]

    def look_at_members(self) -> None:
        """Check rule 1: the hashes of the members."""
        self.manifest = json.loads(self.read("manifest.json"))
        members = self.manifest["members"]
        if self.manifest["format"] != FORMAT or {*self.manifest} != FIELDS:
            self.findings.append(f"manifest.json: its format is not {FORMAT!r}")
        for name, times in sorted(Counter(self.names).items()):
            if name not in members and name not in OWN:
                self.findings.append(f"{name!a}: does not belong to the bundle")
            if times > 1:
                self.findings.append(f"{name!a}: is present more than once")
        for name in members.keys() - set(self.names):
            self.findings.append(f"{name!a}: is missing")
        for name in sorted(members.keys() & set(self.names)):
            digest = hashlib.sha256()
            try:
                with self.open(name) as file:
                    for piece in iter(lambda: file.read(1 << 20), b""):
                        digest.update(piece)
            except Exception as error:  # a damaged ZIP file raises whatever it likes
                self.findings.append(f"{name!a}: cannot be read: {error}")
            self.sums[name] = digest.hexdigest()
            if self.sums[name] != members[name]["sha256"]:
                self.findings.append(f"{name!a}: was changed")

    def look_at_proof(self) -> None:
        """Check rule 2: the export's record in the log has the hash of the manifest."""
        (record,) = self.records("proof.json")
        if record["event"] != "evidence exported":
            self.findings.append("proof.json: is not a record of an export")
        if json.loads(record["detail"])["manifest"] != sha256(self.read("manifest.json")).hex():
            self.findings.append("manifest.json: does not match the hash in the log")

    def look_at_records(self) -> None:
        """Check rule 3: the chain of records."""
        since, until = self.manifest["since"], self.manifest["until"]
        runs = Runs(self.manifest["runs"])
        beside, missing = runs.beside, runs.missing
        for record in self.records("records.ndjson", runs):
            sequence = record["sequence"]
            if runs.meet(sequence, sequence):
                missing -= 1
                self.revisions.add(record["revision"])
            elif sequence in beside:
                beside[sequence] = True
                if since <= record["time"] < until:
                    self.findings.append(
                        f"record {sequence}: belongs to this period, but its run ends before it"
                    )
            self.note_hash(record["event"], record["revision"], json.loads(record["detail"]))
        if missing:
            records = "record of its runs is" if missing == 1 else "records of its runs are"
            self.findings.append(f"records.ndjson: {missing} {records} missing")
        if self.copies and self.manifest["log"] not in {log for log, _number in self.copies}:
            self.blame(FOREIGN, "the checkpoints kept elsewhere: are of other logs, and none of this one")
        first, last = runs.first[0], runs.last[-1]
        if not beside[first - 1] and first > 1:
            self.notes.append(f"records before {first}: removed by retention")
        if not beside[last + 1]:
            self.notes.append(f"record {last} as the last of this period: the log ended there")

    def note_hash(self, event: str, revision: int, detail: dict[str, Any]) -> None:
        if event == "policy loaded":
            self.loads[f"policies/{revision}.ini"] = detail.get("sha256")
        elif event == "specifications loaded":
            self.loads[f"specifications/{detail['revision_of_specifications']}/"] = detail.get("sha256")
        elif event == "recording closed" and detail.get("recording") == self.manifest["recording"]:
            self.loads["recording/recording.bag"] = detail["sha256"]

    def look_at_texts(self) -> None:
        """Check rule 4: policies, specifications and the recording."""
        missing = {*self.manifest["missing"]}
        folders: dict[str, list[str]] = defaultdict(list)
        for name in sorted(self.sums):
            folders["/".join(name.split("/")[:2]) + "/"].append(name)
        for place, wanted in self.loads.items():
            lines = "".join(f"{self.sums[name]}  {name[len(place) :]}\n" for name in folders.get(place, ()))
            found = sha256(lines.encode()).hex() if place.endswith("/") else self.sums.get(place)
            if place in missing:
                self.notes.append(f"{place}: the appliance does not have it")
            elif wanted is None:
                self.notes.append(f"{place}: it was loaded by a version that recorded no hash")
            elif found != wanted:
                self.findings.append(f"{place}: does not match the hash in the log")
        used = {f"policies/{revision}.ini" for revision in self.revisions if revision}
        used |= {"recording/recording.bag"} if self.manifest["recording"] else set()
        self.notes += [f"{place}: the log has no record of it" for place in sorted(used - self.loads.keys())]
        if not any(place.startswith("specifications/") for place in self.loads):
            self.notes.append("the specifications in force: the log has no record of a load")

    def records(self, name: str, runs: Runs | None = None) -> Iterator[dict[str, Any]]:
        walk = Excerpt()
        with self.open(name) as lines:
            for line in iter(lambda: lines.readline(MAX), b""):
                record = json.loads(line)
                chain, sequence = record["chain"], record["sequence"]
                written = json.dumps(record, separators=(",", ":")).encode() + b"\n"
                if line != written or {*record} != {*COLUMNS, "detail", "chain"} or {*chain} - CHAIN:
                    self.findings.append(f"record {sequence}: is not in the appliance's format")
                detail = record["detail"].encode("utf-8", "surrogateescape")
                columns = b"\xdc\x00\x13" + b"".join(
                    map(pack, [*(record[column] for column in COLUMNS), detail])
                )
                before, own = unhex(chain["previous"]), unhex(chain["hash"])
                for fault in walk.add(sequence, before, columns, own):
                    what = (
                        "was changed" if fault is ProofFault.CHANGED else "does not follow the one before it"
                    )
                    self.findings.append(f"record {sequence}: {what}")
                for content in chain["then"] or ():
                    walk.skip(unhex(content))
                if chain["then"] is None:
                    matters = runs is None or runs.meet(walk.begin, sequence)
                    text = "lead to no checkpoint; version 0.1.0 wrote later records"
                    text = f"records {walk.begin} to {sequence}: {text}"
                    (self.findings if matters else self.notes).append(text)
                    walk.begin = 0
                elif chain.get("checkpoint"):
                    self.look_at_checkpoint(chain["checkpoint"], walk)
                    walk.begin = 0
                yield record
        if walk.begin or not walk.sequence:
            self.findings.append(f"{name}: no signed checkpoint seals the records from {walk.begin} on")

    def look_at_checkpoint(self, given: dict[str, Any], walk: Excerpt) -> None:
        number = given["number"]
        place = self.manifest["log"], walk.sequence, walk.hash.hex()
        if (given["log"], given["sequence"], given["hash"]) != place:
            self.findings.append(
                f"checkpoint {number}: does not seal the records up to {walk.sequence} of this bundle"
            )
        signed = self.is_signed(given)
        if not signed or {*given} - {*Checkpoint._fields, "signature", "key"}:
            self.blame(UNSIGNED, f"checkpoint {number}: is not signed with the key")
        copies = self.copies.get((self.manifest["log"], number), [])
        for copy in copies:
            if checkpoint_of(copy) != checkpoint_of(given):
                but = "" if self.is_signed(copy) else ", which is not signed with the key"
                self.blame(REWRITTEN, f"checkpoint {number}: differs from the one kept elsewhere{but}")
        self.checkpoints, self.signed = self.checkpoints + 1, self.signed + signed
        self.agreeing += any(checkpoint_of(copy) == checkpoint_of(given) for copy in copies)

    def is_signed(self, given: dict[str, Any]) -> bool:
        made = checkpoint_of(given)
        try:
            same = parse_checkpoint(made.text()) == made
            fault = signature_fault(
                made.text(), given["signature"], given["key"], self.raw_key, self.has_signed
            )
        except ValueError:
            return False
        return same and fault is None

    def has_signed(self, _key: bytes, signature: bytes, text: bytes) -> bool:
        signed, stated = (self.key.with_name(name) for name in ("signature", "text"))
        signed.write_bytes(signature)
        stated.write_bytes(text)
        order = ["openssl", "pkeyutl", "-verify", "-rawin", "-pubin", "-inkey"]
        files = [str(self.key), "-in", str(stated), "-sigfile", str(signed)]
        return subprocess.run([*order, *files], capture_output=True).returncode == 0


def checkpoint_of(given: dict[str, Any]) -> Checkpoint:
    fields: Any = (given.get(field) for field in Checkpoint._fields)
    return Checkpoint(*fields)


def kept_copies(path: Path) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Return all checkpoints of a file by log and number: root may have added some later. Skip other lines."""
    kept: dict[tuple[str, int], list[dict[str, Any]]] = defaultdict(list)
    with regular(path) as file:
        for line in iter(lambda: file.readline(MAX), b""):
            try:
                copy = json.loads(line)
                bytes.fromhex(copy["signature"] + copy["key"])
                made = parse_checkpoint(checkpoint_of(copy).text())
            except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
                continue
            kept[made.log, made.number].append(copy)
    return kept


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description="Verify an evidence bundle of a ROSRV appliance.")
    parser.add_argument(
        "bundle", nargs="?", type=Path, default=Path(__file__).parent, help="ZIP file or folder"
    )
    parser.add_argument("--key", type=Path, help="the appliance's public key (PEM), kept elsewhere")
    parser.add_argument(
        "--checkpoints", type=Path, help="output of `rosrv audit checkpoints`, kept elsewhere"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        try:
            copies = kept_copies(given.checkpoints) if given.checkpoints else {}
            verifier = Verifier(given.bundle, given.key, Path(folder), copies)
        except Exception as error:
            bad = isinstance(error, zipfile.BadZipFile)
            why = f"{given.bundle}: not an evidence bundle: {error}" if bad else str(error)
            if isinstance(error, OSError) and error.filename:
                why = f"{error.filename}: {error.strerror}"
                if given.bundle.is_dir() and Path(error.filename).parent == given.bundle:
                    why = f"{given.bundle}: not an evidence bundle: it has no {Path(error.filename).name}"
            print(printable(f"nothing can be verified: {why}"))
            return 2
        verifier.run()
    findings = [*dict.fromkeys(map(printable, verifier.findings))]
    notes = [*map(printable, verifier.notes)]
    if given.json:
        said = {"ok": not findings, "findings": findings, "unproven": notes, "key": verifier.raw_key}
        counts = {"checkpoints": verifier.checkpoints, "kept_elsewhere": verifier.agreeing}
        print(json.dumps({**said, **counts}))
        return 1 if findings else 0
    for finding in findings:
        print(f"WRONG     {finding}")
    for note in notes:
        print(f"unproven  {note}")
    if given.checkpoints:
        checkpoints = "checkpoint was" if verifier.checkpoints == 1 else "checkpoints were"
        print(f"{verifier.agreeing} of {verifier.checkpoints} {checkpoints} also kept elsewhere")
    print(
        f"key {verifier.raw_key}{'' if given.key else ', from the bundle: compare it with a copy kept elsewhere'}"
    )
    print(verifier.verdict())
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
