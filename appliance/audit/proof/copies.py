"""Export signed checkpoints to another machine, and compare the log with these copies.

Root on the appliance can rewrite the whole history with valid signatures; only copies on another machine reveal this.
Copies that prove nothing, because they are from other logs or seal only removed records, are a finding.
"""

import json
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.signatures import signature_is_valid
from appliance.audit.proof.chain_findings import Elsewhere, FindingKind, LogFinding
from appliance.base.counted import counted
from appliance.base.input_files import open_given
from appliance.signing.log_proof import Checkpoint, ProofFault, parse_checkpoint, signature_fault

SYSLOG_ELEMENT = "rosrvCheckpoint@32473"
_LONGEST_LINE = 65_536
_ELEMENT = re.compile(rf"\[{re.escape(SYSLOG_ELEMENT)}((?: [a-z]++=\"[0-9a-f]*+\")+)\]")
_PARAMETER = re.compile(r' ([a-z]++)="([0-9a-f]*+)"')


class CopiesUnreadableError(Exception):
    """A file is unreadable or has no checkpoints."""


class KnownLog(NamedTuple):
    """A log that checkpoints are compared with, and the key that must have signed them (None: their own)."""

    id: str
    key: str | None
    first: int
    last: int
    hash_at: Callable[[int], bytes | None]
    text_of: Callable[[int], bytes | None]


class SignedCheckpoint(msgspec.Struct, frozen=True, omit_defaults=True):
    """A checkpoint with its signature, as it is exported; hashes, signature and key are in hexadecimal.

    `time` is in nanoseconds since the epoch; `removed` is the last record removed from the log's beginning, if known.
    JSON and syslog messages use these names.
    """

    log: Annotated[str, msgspec.Meta(description="id of the log")]
    number: Annotated[int, msgspec.Meta(description="number, from 1")]
    sequence: Annotated[int, msgspec.Meta(description="sequence of the last record that it seals")]
    hash: Annotated[str, msgspec.Meta(description="hash of the chain at that record, in hexadecimal")]
    time: Annotated[int, msgspec.Meta(description="nanoseconds since the epoch")]
    previous: Annotated[str, msgspec.Meta(description="hash of the checkpoint before, in hexadecimal")]
    signature: Annotated[str, msgspec.Meta(description="Ed25519, in hexadecimal")]
    key: Annotated[str, msgspec.Meta(description="public key, in hexadecimal")]
    removed: Annotated[
        int | None,
        msgspec.Meta(description="sequence up to which retention had removed records, or null if it had not"),
    ] = None

    @classmethod
    def of(cls, text: bytes, signature: bytes, key: bytes) -> "SignedCheckpoint":
        """Return a checkpoint as it is exported. Raises `ValueError` for a malformed text."""
        return cls(**parse_checkpoint(text)._asdict(), signature=signature.hex(), key=key.hex())

    @property
    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            self.log, self.number, self.sequence, self.hash, self.time, self.previous, self.removed
        )

    def text(self) -> bytes:
        return self.checkpoint.text()

    def fault(self, expected: str | None = None) -> ProofFault | None:
        try:
            parse_checkpoint(self.text())
        except ValueError:
            return ProofFault.SIGNATURE  # nothing that a signer signs
        key = self.key if expected is None else expected
        return signature_fault(self.text(), self.signature, self.key, key, signature_is_valid)

    def fault_in(self, log: KnownLog) -> ProofFault | None:
        if self.log != log.id:
            return ProofFault.LOG
        fault = self.fault(log.key)
        if fault is not None or self.sequence < log.first:
            return fault
        fault = self.checkpoint.contradiction(log.last, log.hash_at(self.sequence))
        changed = fault is None and log.text_of(self.number) not in (None, self.text())
        return ProofFault.OTHER if changed else fault

    def as_json(self) -> str:
        return msgspec.json.encode(self).decode("ascii")


def select_signed(connection: sqlite3.Connection, where: str, *values: int) -> list[SignedCheckpoint]:
    """Return the signed checkpoints for which the SQL condition `where` holds. Raises `ValueError` for a bad one."""
    query = "SELECT text, signature, public_key FROM checkpoint WHERE signature IS NOT NULL AND public_key IS NOT NULL"
    found = connection.execute(f"{query} AND {where}", values)
    return [SignedCheckpoint.of(*row) for row in found]


def signed_checkpoints(log: Path, after: int = 0, limit: int = 1000) -> list[SignedCheckpoint]:
    """Return the signed checkpoints after the number `after`, in order. Raises `LogUnreadableError`."""
    return _read(log, "number > ? ORDER BY number LIMIT ?", after, limit)


def newest_checkpoint(log: Path) -> SignedCheckpoint | None:
    """Return the last signed checkpoint, or None. Raises `LogUnreadableError`."""
    return next(iter(_read(log, "true ORDER BY number DESC LIMIT 1")), None)


def _read(log: Path, where: str, *values: int) -> list[SignedCheckpoint]:
    with reading(log) as connection:
        try:
            return select_signed(connection, where, *values)
        except ValueError as error:
            raise LogUnreadableError(f"{log}: cannot be read: {error}; run 'rosrv audit verify'") from error


def read_copies(file: Path) -> list[SignedCheckpoint]:
    """Return the checkpoints in NDJSON (`rosrv audit checkpoints`) or a syslog receiver's output; skip the rest.

    Raises `CopiesUnreadableError` if there is no checkpoint.
    """
    found = []
    try:
        with open_given(file) as lines:
            for line in iter(lambda: lines.readline(_LONGEST_LINE), b""):
                copy = _parse(line.decode("utf-8", "replace"))
                if copy is not None:
                    found.append(copy)
    except OSError as error:
        raise CopiesUnreadableError(f"the checkpoints {file} cannot be read: {error.strerror}") from error
    if not found:
        raise CopiesUnreadableError(
            f"{file}: no checkpoint in it; it takes lines of 'rosrv audit checkpoints', or of a syslog receiver"
        )
    return found


def _parse(line: str) -> SignedCheckpoint | None:
    fields: object = None
    element = _ELEMENT.search(line)
    if element is not None:
        fields = dict(_PARAMETER.findall(element[1]))
    elif line.lstrip().startswith("{"):
        try:
            fields = json.loads(line)
        except (ValueError, RecursionError):
            return None
    try:
        copy = msgspec.convert(fields, SignedCheckpoint, strict=False)
        bytes.fromhex(copy.signature + copy.key)
        parse_checkpoint(copy.text())
    except ValueError:
        return None
    return copy


_WORDS = {
    ProofFault.KEY: (
        FindingKind.WRONG_KEY,
        ", kept elsewhere: signed with {copy.key}, expected is {log.key}",
    ),
    ProofFault.SIGNATURE: (FindingKind.SIGNATURE_WRONG, ", kept elsewhere: its signature does not fit it"),
    ProofFault.OTHER: (FindingKind.CHECKPOINT_CHANGED, ": another one than was given to the other machine"),
}


class CopiesVerifier:
    """Verifies copies against the log with the id `log`; `key` must have signed them."""

    def __init__(self, log: str, key: bytes | None, copies: Iterable[SignedCheckpoint]) -> None:
        copies = list(copies)
        self._log = log
        self._key = key
        self._others = sorted({copy.log for copy in copies if copy.log != log})
        self._copies = sorted({copy for copy in copies if copy.log == log}, key=lambda copy: copy.number)
        self.sequences = {copy.sequence for copy in self._copies}
        self.numbers = {copy.number for copy in self._copies}
        self._agreeing: list[SignedCheckpoint] = []
        self.removed: list[int] = []
        """The values of `removed` in copies."""

    def result(self) -> Elsewhere:
        last = self._agreeing[-1] if self._agreeing else None
        return Elsewhere(
            checkpoints=len(self._agreeing),
            through=last.sequence if last else 0,
            time=last.time if last else 0,
            other_logs=self._others,
        )

    def check(
        self, chain: dict[int, bytes], removed: int, last: int, texts: dict[int, bytes]
    ) -> list[LogFinding]:
        key = None if self._key is None else self._key.hex()
        log = KnownLog(self._log, key, removed, last, chain.get, texts.get)
        found = list(self._compare(log))
        if not self._copies:
            names = ", ".join(self._others)
            message = (
                f"the checkpoints kept elsewhere are of log {names}; this one, {self._log}, took its place"
            )
            found.append(LogFinding(FindingKind.LOG_REPLACED, 0, 0, message))
        elif not self._agreeing and not found:
            message = (
                f"of {counted(len(self._copies), 'checkpoint')} kept elsewhere none is of what is left of the"
                " log, which begins"
                f" after record {removed}: they prove nothing of it"
            )
            found.append(LogFinding(FindingKind.PROVES_NOTHING, 0, removed, message))
        return found

    def _compare(self, log: KnownLog) -> Iterator[LogFinding]:
        proven = log.first
        for copy in self._copies:
            fault, sequence = copy.fault_in(log), copy.sequence
            if fault in _WORDS:
                kind, words = _WORDS[fault]
                name = f"checkpoint {copy.number}"
                yield LogFinding(kind, copy.number, copy.number, name + words.format(copy=copy, log=log))
            if fault in (ProofFault.KEY, ProofFault.SIGNATURE):
                continue
            self.removed += [] if copy.removed is None else [copy.removed]
            if fault is ProofFault.CUT_OFF:
                message = (
                    f"records {log.last + 1} to {sequence} are gone from the end: checkpoint {copy.number},"
                    " kept elsewhere, has sealed them"
                )
                yield LogFinding(FindingKind.TRUNCATED, log.last + 1, sequence, message)
                return
            if fault is ProofFault.REWRITTEN:
                message = (
                    f"records {proven + 1} to {sequence} are not those that checkpoint {copy.number}, kept elsewhere,"
                    " sealed: history was rewritten with the signer's key"
                )
                yield LogFinding(FindingKind.REWRITTEN, proven + 1, sequence, message)
                return
            if (
                sequence >= log.first and fault is not ProofFault.MISSING
            ):  # the finding about a record reports it
                proven = sequence
                self._agreeing.append(copy)
