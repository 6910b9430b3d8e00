"""Export signed checkpoints to another machine, and compare the log with these copies.

Root on the appliance has the signer's key and memory, and can rewrite the whole history with valid signatures. Copies
on another machine are out of root's reach. Therefore:

1. A copy contains the complete signed text and the signature, so it can be verified anywhere.
2. A log agrees with a copy if its chain has the copy's hash at the copy's sequence.
3. A copy with an invalid signature is a finding. Copies from other logs are listed. If all copies are from other logs,
   this log replaced another one, which is a finding.
4. If all copies seal records that were removed since, this is a finding: they prove nothing about the remaining
   records.
"""

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.signatures import signature_is_valid
from appliance.audit.proof.chain_findings import Elsewhere, FindingKind, LogFinding
from appliance.base.input_files import open_given
from appliance.signing.log_proof import Checkpoint, ProofFault, parse_checkpoint, signature_fault

SYSLOG_ELEMENT = "rosrvCheckpoint@32473"
_LONGEST_LINE = 65_536
_ELEMENT = re.compile(rf"\[{re.escape(SYSLOG_ELEMENT)}((?: [a-z]++=\"[0-9a-f]*+\")+)\]")
_PARAMETER = re.compile(r' ([a-z]++)="([0-9a-f]*+)"')


class CopiesUnreadableError(Exception):
    """A file is unreadable or has no checkpoints."""


class SignedCheckpoint(msgspec.Struct, frozen=True, omit_defaults=True):
    """A checkpoint with its signature, as it is exported; hashes, signature and key are in hexadecimal.

    `time` is in nanoseconds since the epoch; `removed` is the last record removed from the log's beginning, if known.
    JSON and syslog messages use these names.
    """

    log: str
    number: int
    sequence: int
    hash: str
    time: Annotated[int, msgspec.Meta(description="nanoseconds since the epoch")]
    previous: str
    signature: str
    key: str
    removed: int | None = None

    @classmethod
    def of(cls, text: bytes, signature: bytes, key: bytes) -> "SignedCheckpoint":
        """Parse the text of a checkpoint. Raises `ValueError`."""
        return cls(**parse_checkpoint(text)._asdict(), signature=signature.hex(), key=key.hex())

    @property
    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            self.log, self.number, self.sequence, self.hash, self.time, self.previous, self.removed
        )

    def text(self) -> bytes:
        return self.checkpoint.text()

    def fault(self, expected: str | None = None) -> ProofFault | None:
        """Return why the key `expected` (default: the checkpoint's) did not sign it, or None.

        Raises `ValueError` for fields that are not those of a checkpoint.
        """
        parse_checkpoint(self.text())
        return signature_fault(
            self.text(), self.signature, self.key, expected or self.key, signature_is_valid
        )

    def as_json(self) -> str:
        return msgspec.json.encode(self).decode("ascii")


def signed_checkpoints(log: Path, after: int = 0, limit: int = 1000) -> list[SignedCheckpoint]:
    """Return at most `limit` signed checkpoints of the log with numbers above `after`, in order.

    Raises `LogUnreadableError`.
    """
    query = (
        "SELECT text, signature, public_key FROM checkpoint WHERE number > ? AND signature IS NOT NULL"
        " AND public_key IS NOT NULL ORDER BY number LIMIT ?"
    )
    with reading(log) as connection:
        rows = connection.execute(query, (after, limit)).fetchall()
    try:
        return [SignedCheckpoint.of(*row) for row in rows]
    except ValueError as error:
        raise LogUnreadableError(f"{log}: cannot be read: {error}; run 'rosrv audit verify'") from error


def newest_checkpoint(log: Path) -> SignedCheckpoint | None:
    """Return the last signed checkpoint of the log, or None. Raises `LogUnreadableError`."""
    query = "SELECT max(number) FROM checkpoint WHERE signature IS NOT NULL AND public_key IS NOT NULL"
    with reading(log) as connection:
        (number,) = connection.execute(query).fetchone()
    found = [] if number is None else signed_checkpoints(log, number - 1, 1)
    return found[0] if found else None


def read_copies(file: Path) -> list[SignedCheckpoint]:
    """Return the checkpoints in a file: NDJSON (`rosrv audit checkpoints`), or the output of a syslog receiver.

    Other lines are skipped. Raises `CopiesUnreadableError` if there is no checkpoint.
    """
    found = []
    try:
        with open_given(file) as lines:
            for line in iter(lambda: lines.readline(_LONGEST_LINE), b""):
                copy = _parse(line.decode("utf-8", "replace"))
                if copy is not None:
                    found.append(copy)
    except OSError as error:
        raise CopiesUnreadableError(f"{file}: {error.strerror}") from error
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


class CopiesVerifier:
    """Verifies copies against the chain of the log with the id `log`; `key` must have signed the copies."""

    def __init__(self, log: str, key: bytes | None, copies: Iterable[SignedCheckpoint]) -> None:
        copies = list(copies)
        self._log = log
        self._key = key
        self._others = sorted({copy.log for copy in copies if copy.log != log})
        self._copies = sorted({copy for copy in copies if copy.log == log}, key=lambda copy: copy.number)
        self.sequences = {copy.sequence for copy in self._copies}
        self._agreeing: list[SignedCheckpoint] = []
        self.removed: list[int] = []
        """The values of `removed` in copies."""

    def result(self) -> Elsewhere:
        """Return the number of agreeing copies, and how far they prove the log."""
        last = self._agreeing[-1] if self._agreeing else None
        return Elsewhere(
            checkpoints=len(self._agreeing),
            through=last.sequence if last else 0,
            time=last.time if last else 0,
            other_logs=self._others,
        )

    def check(
        self, chain: dict[int, bytes], removed: int, last: int, stored: dict[int, str]
    ) -> Iterator[LogFinding]:
        """Yield the findings. `chain` has the hashes at `sequences`; `stored` the log's own checkpoints by number.

        `removed` and `last` are the sequences of the last removed record and of the last record.
        """
        if not self._copies:
            names = ", ".join(self._others)
            message = (
                f"the checkpoints kept elsewhere are of log {names}; this one, {self._log}, took its place"
            )
            yield LogFinding(FindingKind.LOG_REPLACED, 0, 0, message)
        found = list(self._compare(chain, removed, last, stored))
        yield from found
        if self._copies and not self._agreeing and not found:
            message = (
                f"of {len(self._copies)} checkpoints kept elsewhere none is of what is left of the log, which begins"
                f" after record {removed}: they prove nothing of it"
            )
            yield LogFinding(FindingKind.PROVES_NOTHING, 0, removed, message)

    def _compare(
        self, chain: dict[int, bytes], removed: int, last: int, stored: dict[int, str]
    ) -> Iterator[LogFinding]:
        proven = removed
        for copy in self._copies:
            wrong = self._wrong_signature(copy)
            if wrong is not None:
                yield wrong
                continue
            self.removed += [] if copy.removed is None else [copy.removed]
            if copy.sequence < removed:
                continue
            here = chain.get(copy.sequence)
            fault = copy.checkpoint.contradiction(last, here)
            if fault is ProofFault.CUT_OFF:
                message = (
                    f"records {last + 1} to {copy.sequence} are gone from the end: checkpoint {copy.number},"
                    " kept elsewhere, has sealed them"
                )
                yield LogFinding(FindingKind.TRUNCATED, last + 1, copy.sequence, message)
                return
            if fault is not None:
                yield self._rewritten(copy, proven)
                return
            if here is None:
                continue  # the sealed record is missing; the finding about that record reports it
            proven = copy.sequence
            self._agreeing.append(copy)
            if stored.get(copy.number, copy.text().hex()) != copy.text().hex():
                message = f"checkpoint {copy.number}: another one than was given to the other machine"
                yield LogFinding(FindingKind.CHECKPOINT_CHANGED, copy.number, copy.number, message)

    def _rewritten(self, copy: SignedCheckpoint, proven: int) -> LogFinding:
        message = (
            f"records {proven + 1} to {copy.sequence} are not those that checkpoint {copy.number}, kept elsewhere,"
            " sealed: history was rewritten with the signer's key"
        )
        return LogFinding(FindingKind.REWRITTEN, proven + 1, copy.sequence, message)

    def _wrong_signature(self, copy: SignedCheckpoint) -> LogFinding | None:
        name, number = f"checkpoint {copy.number}, kept elsewhere", copy.number
        expected = None if self._key is None else self._key.hex()
        match copy.fault(expected):
            case ProofFault.KEY:
                message = f"{name}: signed with {copy.key}, expected is {expected}"
                return LogFinding(FindingKind.WRONG_KEY, number, number, message)
            case ProofFault.SIGNATURE:
                message = f"{name}: its signature does not fit it"
                return LogFinding(FindingKind.SIGNATURE_WRONG, number, number, message)
        return None
