"""Verify an export of the audit log with the bundle verifier (`rosrv audit verify --export`, deprecated)."""

import json
import tempfile
from collections import deque
from pathlib import Path
from typing import IO

import msgspec

from appliance.audit.log.columns import to_columns
from appliance.audit.log.record_format import entry_of
from appliance.audit.log.signatures import write_public_key
from appliance.audit.proof.chain_proofs import ChainProof
from appliance.base.input_files import lines_given
from appliance.evidence.bundle import stored_line
from appliance.evidence.bundle_verifier import Verifier

_LONGEST_LINE = 16 << 20
_NOT_A_RECORD = (ValueError, KeyError, TypeError, RecursionError)


class ExportUnreadableError(Exception):
    """A file is missing or is not an export with proofs."""


class ExportVerification(msgspec.Struct, kw_only=True):
    """The result of a verification; `ok` if nothing is wrong.

    The export has `records` records, from sequence `first` to `last`: `proven` of them lead to a signed checkpoint,
    `unsealed` come after the last one. `left_out` records between `first` and `last` are not in the
    export, which is a finding unless it is an excerpt. `logs` are
    the ids of the logs that the checkpoints name.
    """

    ok: bool = False
    records: int = 0
    first: int = 0
    last: int = 0
    proven: int = 0
    unsealed: int = 0
    left_out: int = 0
    logs: list[str] = []
    key: str
    findings: list[str] = []


def verify_export(file: Path, key: bytes, *, excerpt: bool) -> ExportVerification:
    """Verify an export with the raw public key. Raises `ExportUnreadableError`.

    Only of an `excerpt`, which a filter made, may records be missing in between: nothing in the export tells them from
    records that were removed later.
    """
    result = ExportVerification(key=key.hex())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_public_key(folder / "audit.pub", key)
        with (folder / "records.ndjson").open("wb") as stored:
            try:
                sealed = _store(file, stored, result)
            except OSError as error:
                raise ExportUnreadableError(f"{file}: {error.strerror}") from error
        verifier = Verifier(folder, None, folder, {})
        verifier.manifest = {"log": result.logs[0] if result.logs else ""}
        try:
            deque(verifier.records("records.ndjson"), maxlen=0)
        except ValueError as error:
            verifier.findings.append(f"a signature cannot be read: {error}")
    result.findings = verifier.findings
    result.proven = 0 if result.findings else sealed
    result.unsealed = result.records - sealed
    result.left_out = max(0, result.last - result.first + 1 - result.records)
    result.findings += gaps(result, excerpt=excerpt)
    result.ok = not result.findings
    return result


def gaps(result: ExportVerification, *, excerpt: bool) -> list[str]:
    """Return a finding if records are missing in an export that is not an excerpt."""
    if excerpt or not result.left_out:
        return []
    where = f"from {result.first} to {result.last}"
    return [f"{result.left_out} records {where} are missing: if a filter left them out, give --excerpt"]


def _store(file: Path, stored: IO[bytes], result: ExportVerification) -> int:
    """Write the records in the format of a bundle, up to the last signed checkpoint; return their number."""
    sealed = end = 0
    for number, line in enumerate(lines_given(file, _LONGEST_LINE), 1):
        if not line.strip():
            continue
        try:
            fields = json.loads(line)
            entry, chain = entry_of(fields), msgspec.convert(fields["chain"], ChainProof)
        except _NOT_A_RECORD as error:
            raise ExportUnreadableError(
                f"{file}:{number}: not a record with its place in the chain ({type(error).__name__}: {error}); it takes"
                " what 'rosrv audit export' writes"
            ) from error
        stored.write(stored_line(to_columns(entry.record, entry.sequence), chain))
        result.records += 1
        result.first, result.last = result.first or entry.sequence, entry.sequence
        if chain.checkpoint is not None:
            sealed, end = result.records, stored.tell()
            result.logs = sorted({*result.logs, chain.checkpoint.log})
    stored.truncate(end)
    return sealed
