"""Export records with their proofs: their position in the chain, up to a signed checkpoint.

`appliance/formats/bundle_verifier.py` verifies them with the public key alone.
"""

import itertools
import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from appliance.audit.log.columns import StoredColumns, content_hash
from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.log_queries import chained_rows, record_hash
from appliance.audit.log.record_format import LogEntry, as_json
from appliance.audit.proof.checkpoints import last_removal
from appliance.audit.proof.copies import SignedCheckpoint, select_signed
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.signing.log_proof import NO_CHECKPOINT, genesis, link

_Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class ChainProof(msgspec.Struct, frozen=True, kw_only=True):
    """The position of a record in the chain; hashes are in hexadecimal.

    `then` is None if version 0.1.0 wrote the following records, whose hashes need their content.
    """

    previous: _Hash
    hash: _Hash
    then: list[_Hash] | None
    checkpoint: SignedCheckpoint | None = None


def evidence(path: Path, wanted: Filter, page: int = 1000) -> Iterator[tuple[LogEntry, ChainProof]]:
    """Yield the records found with their proofs, oldest first. Raises `LogUnreadableError` and `FilterError`."""
    entries, ahead = itertools.tee(export(path, wanted, page))
    following = itertools.chain((entry.sequence for entry in itertools.islice(ahead, 1, None)), [0])
    pairs = zip(entries, following, strict=False)
    while part := list(itertools.islice(pairs, page)):
        with reading(path) as connection:
            connection.execute("BEGIN")
            places = ChainReader(connection)
            chains = [places.place(entry.sequence, after) for entry, after in part]
        for (entry, _after), chain in zip(part, chains, strict=True):
            if chain is None:
                raise LogUnreadableError(
                    f"{path}: retention removed record {entry.sequence} while it was exported: export again"
                )
            yield entry, chain


def evidence_line(entry: LogEntry, chain: ChainProof, robot: str = "") -> str:
    name = f'"robot":{json.dumps(robot)},' if robot else ""
    return f'{as_json(entry)[:-1]},{name}"chain":{msgspec.json.encode(chain).decode("ascii")}}}'


def stored_line(columns: StoredColumns, chain: ChainProof) -> bytes:
    stored = columns._asdict() | {"detail": columns.detail.decode("utf-8", "surrogateescape")}
    return json.dumps({**stored, "chain": msgspec.to_builtins(chain)}, separators=(",", ":")).encode() + b"\n"


class ChainReader:
    """Reads proofs, in ascending order, from one snapshot of a log."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        (self._log,) = connection.execute("SELECT id FROM log").fetchone()
        self._sealing: SignedCheckpoint | None = None
        self._unsealed = False
        self._before: tuple[int, str] = (-1, "")

    def place(self, sequence: int, following: int) -> ChainProof | None:
        """Return the proof up to the record `following` (0: none); None for a removed record."""
        digest = record_hash(self._connection, sequence)
        if digest is None:
            return None
        checkpoint = self._checkpoint(sequence)
        ends = checkpoint if checkpoint and (not following or checkpoint.sequence < following) else None
        upto = ends.sequence if ends else following - 1
        previous = self._previous(sequence)
        self._before = sequence, digest.hex()
        return ChainProof(
            previous=previous,
            hash=digest.hex(),
            then=self._contents(digest, sequence, upto) if upto > sequence else [],
            checkpoint=ends,
        )

    def _previous(self, sequence: int) -> str:
        if self._before[0] == sequence - 1:
            return self._before[1]
        digest = record_hash(self._connection, sequence - 1)
        if digest is not None:
            return digest.hex()
        if sequence == 1:
            return genesis(str(self._log)).hex()
        removed = last_removal(self._connection)
        return NO_CHECKPOINT if removed is None else removed.last_hash

    def _checkpoint(self, sequence: int) -> SignedCheckpoint | None:
        known = self._sealing
        if self._unsealed or (known is not None and known.sequence >= sequence):
            return None if self._unsealed else known
        where, after = "number > ? AND sequence >= ? ORDER BY number LIMIT 1", known.number if known else 0
        self._sealing = next(iter(select_signed(self._connection, where, after, sequence)), None)
        self._unsealed = self._sealing is None
        return self._sealing

    def _contents(self, digest: bytes, after: int, upto: int) -> list[str] | None:
        contents = []
        for row in chained_rows(self._connection, after, upto):
            content = content_hash(row[:-1])
            digest = link(digest, content)
            if digest != row[-1]:
                return None
            contents.append(content.hex())
        return contents
