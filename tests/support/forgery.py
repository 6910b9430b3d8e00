import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.columns import record_hash
from appliance.audit.log.log_database import COLUMNS
from appliance.signing.log_proof import NO_CHECKPOINT, checkpoint_hash, genesis, parse_checkpoint

# ruff: noqa: S608  the attacker's statements are built from names of columns

_FIELDS = COLUMNS.split(", ")
_EVENT, _DETAIL = _FIELDS.index("event"), _FIELDS.index("detail")


def write_anew(path: Path, key: Ed25519PrivateKey, signer: Path, change: str) -> None:
    """Rewrite a log as root can: with all hashes, checkpoints, signatures and the signer's memory."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(change)
        rows = connection.execute(f"SELECT {COLUMNS} FROM record ORDER BY sequence").fetchall()
        stored = connection.execute("SELECT number, text FROM checkpoint ORDER BY number").fetchall()
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        waiting = [parse_checkpoint(text) for _number, text in stored]
        connection.execute("DELETE FROM record")
        connection.execute("DELETE FROM checkpoint")
        digest, hashes, previous, sealed, memory = genesis(log_id), {}, NO_CHECKPOINT, {}, b""
        for place, row in enumerate(rows, 1):
            columns = [place, *row[1:]]
            if columns[_EVENT] == "checkpoint":
                old = waiting.pop(0)
                new = old._replace(sequence=place - 1, hash=digest.hex(), previous=previous)
                text = new.text()
                previous, sealed[old.number] = checkpoint_hash(text), text
                detail = {"number": new.number, "sequence": new.sequence, "hash": new.hash}
                columns[_DETAIL] = msgspec.json.encode(detail, order="deterministic")
                public = key.public_key().public_bytes_raw()
                connection.execute(
                    "INSERT INTO checkpoint VALUES (?, ?, ?, ?, ?)",
                    (new.number, new.sequence, text, key.sign(text), public),
                )
                memory += hashlib.sha256(text).digest()
            digest = record_hash(digest, tuple(columns))
            hashes[place] = digest
            marks = ", ".join("?" * (len(columns) + 1))
            connection.execute(f"INSERT INTO record VALUES ({marks})", (*columns, digest))
        connection.commit()
    signer.mkdir(exist_ok=True)
    (signer / f"{log_id}.signed").write_bytes((1).to_bytes(8, "big") + memory)
