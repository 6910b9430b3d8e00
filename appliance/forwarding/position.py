"""How far the log was forwarded: a small file that outlives the process, and is only ever behind, never ahead.

It is written after the receiver has what it says; what was sent since is sent again after a crash.
"""

from pathlib import Path

import msgspec

from appliance.base.atomic_files import write_whole


class Position(msgspec.Struct, frozen=True):
    """Of the log with this id: the last record's sequence and the last checkpoint's number that were sent.

    `record` is that record's id: by it a log that was put back from a copy is told from one that went on.
    """

    log: str
    sequence: int = 0
    checkpoint: int = 0
    record: str = ""


def load_position(path: Path) -> Position | None:
    """What was kept; None when there is nothing. Raises `ValueError`, `OSError` when it cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Position)
    except FileNotFoundError:
        return None
    except msgspec.DecodeError as error:
        raise ValueError(f"{path}: {error}; remove it to have the whole log forwarded again") from error


def save_position(path: Path, position: Position) -> None:
    """Keep it, on the disk. Raises `OSError`."""
    write_whole(path, msgspec.json.encode(position), 0o600)
