"""Proves an export on any machine, with nothing but the appliance's public key.

A record is proven when a chain of hashes leads from it to a checkpoint that the key signed. The chain goes through
records that the export has and, by their content hashes, through those that a filter left out. Records after the last
signed checkpoint are not proven yet, and counted. That nothing else was left out no export can show.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from appliance.audit.chain import follows, link
from appliance.audit.chain_findings import Kind, LogFinding
from appliance.audit.chain_proofs import Chain
from appliance.audit.columns import to_columns
from appliance.audit.copies import SignedCheckpoint
from appliance.audit.record_format import Entry, entry_of
from appliance.audit.signatures import signature_is_right
from appliance.base.input_files import lines_given

_LONGEST_LINE = 16 << 20
_MOST_FINDINGS = 1000
_NOT_A_RECORD = (msgspec.MsgspecError, ValueError, KeyError, TypeError, RecursionError)


class ExportUnreadableError(Exception):
    """The file is missing, or is no export with places in the chain; the message says which."""


class ExportVerification(msgspec.Struct, frozen=True, kw_only=True):
    """The result: `ok` when nothing is wrong and something is proven.

    `records` are in the export, from `first` to `last`; `proven` of them lead to a signed checkpoint, `unsealed` come
    after the last one. `left_out` records between the first and the last are not in the export. `logs` are the ids of
    the logs that the checkpoints name.
    """

    ok: bool
    records: int
    first: int
    last: int
    proven: int
    unsealed: int
    left_out: int
    logs: list[str]
    key: str
    findings: list[LogFinding]


class _Line(NamedTuple):
    entry: Entry
    chain: Chain
    number: int


def verify_export(file: Path, key: bytes) -> ExportVerification:
    """Check an export against the raw public key. Raises `ExportUnreadableError`."""
    try:
        return _Walk(key).run(_read(file, lines_given(file, _LONGEST_LINE)))
    except OSError as error:
        raise ExportUnreadableError(f"{file}: {error.strerror}") from error


def _read(file: Path, lines: Iterable[bytes]) -> Iterator[_Line]:
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            fields = json.loads(line)
            yield _Line(entry_of(fields), msgspec.convert(fields["chain"], Chain), number)
        except _NOT_A_RECORD as error:
            raise ExportUnreadableError(
                f"{file}:{number}: not a record with its place in the chain ({type(error).__name__}: {error}); it takes"
                " what 'rosrv audit export' writes"
            ) from error


class _Walk:
    """One walk over one export."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._findings: list[LogFinding] = []
        self._logs: set[str] = set()
        self._waiting = 0  # records that lead to the next line, and to a checkpoint only with it
        self._records = self._proven = self._left_out = 0
        self._first = self._last = 0
        # The next line's sequence, and the hash it must follow
        self._expected: tuple[int, bytes] | None = None

    def run(self, lines: Iterator[_Line]) -> ExportVerification:
        """Check every line."""
        for line in lines:
            self._records += 1
            self._step(line)
        if not self._proven and not self._findings:
            self._find(
                Kind.PROVES_NOTHING,
                self._first,
                self._last,
                "no signed checkpoint seals any record of the export",
            )
        return ExportVerification(
            ok=not self._findings, records=self._records, first=self._first, last=self._last, proven=self._proven,
            unsealed=self._waiting, left_out=self._left_out, logs=sorted(self._logs),
            key=self._key.hex(), findings=self._findings,
        )  # fmt: skip

    def _find(self, kind: Kind, first: int, last: int, message: str) -> None:
        if len(self._findings) < _MOST_FINDINGS:
            self._findings.append(LogFinding(kind, first, last, message))

    def _step(self, line: _Line) -> None:
        entry, chain = line.entry, line.chain
        sequence, name = entry.sequence, f"record {entry.sequence} (line {line.number})"
        if self._first and sequence <= self._last:
            self._find(Kind.REORDERED, sequence, sequence, f"{name}: not in the order of the log")
        self._left_out += max(0, sequence - self._last - 1) if self._first else 0
        self._first, self._last = self._first or sequence, max(self._last, sequence)
        previous, digest = bytes.fromhex(chain.previous), bytes.fromhex(chain.hash)
        if not follows(previous, to_columns(entry.record, sequence), digest):
            self._lost(Kind.CHANGED, sequence, f"{name}: does not have the content it was written with")
            return
        if self._expected is not None and self._expected != (sequence, previous):
            self._lost(
                Kind.MISSING, sequence, f"{name}: does not follow the one before it: something was taken out"
            )
        self._waiting += 1
        self._go_on(line, digest)

    def _lost(self, kind: Kind, sequence: int, message: str) -> None:
        """The chain is broken here: what waited for a checkpoint has none."""
        self._find(kind, sequence, sequence, message)
        self._waiting, self._expected = 0, None

    def _go_on(self, line: _Line, digest: bytes) -> None:
        """From a record along the chain: to the next line, or to a checkpoint."""
        chain, place = line.chain, line.entry.sequence
        if chain.then is None:
            self._lost(
                Kind.PROVES_NOTHING,
                place,
                f"record {place} (line {line.number}): records after it that version 0.1.0 wrote were left out, so that"
                " nothing leads to a checkpoint; export without a filter",
            )
            return
        for content in chain.then:
            digest, place = link(digest, bytes.fromhex(content)), place + 1
        checkpoint = chain.checkpoint
        if checkpoint is None:
            self._expected = place + 1, digest
            return
        name = f"checkpoint {checkpoint.number} (line {line.number})"
        if not self._is_signed(checkpoint):
            self._lost(Kind.SIGNATURE_WRONG, checkpoint.number, f"{name}: not signed with {self._key.hex()}")
        elif (checkpoint.sequence, checkpoint.hash) != (place, digest.hex()):
            self._lost(
                Kind.CHANGED, place, f"{name}: seals another chain than the export has up to record {place}"
            )
        else:
            self._logs.add(checkpoint.log)
            self._proven += self._waiting
            self._waiting, self._expected = 0, None

    def _is_signed(self, checkpoint: SignedCheckpoint) -> bool:
        try:
            signature = bytes.fromhex(checkpoint.signature)
        except ValueError:
            return False
        return checkpoint.key == self._key.hex() and signature_is_right(
            self._key, signature, checkpoint.text()
        )
