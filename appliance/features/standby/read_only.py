"""Read a state file that another object writes, such as the replica of a standby."""

import contextlib
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from appliance.store.changes import Change, Value
from appliance.store.writer_thread import Database, StoreError


class ReadOnlyDatabase(Database):
    """The state file at `path`. It has no thread and no file of queued changes, and takes no changes."""

    def __init__(self, path: Path, schema: str, *, failed: Callable[[str], None]) -> None:
        """Take the arguments of `Database`; only the path matters."""
        del schema, failed
        self._path = path

    def query(self, sql: str, parameters: Sequence[Value] = ()) -> list[tuple[Any, ...]]:
        """Read the rows as they are now. Raises `StoreError`."""
        try:
            with contextlib.closing(sqlite3.connect(f"{self._path.as_uri()}?mode=ro", uri=True)) as reader:
                return reader.execute(sql, parameters).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from error

    def _submit(self, change: Change, *, ahead: bool) -> None:
        del change, ahead
        raise StoreError(f"{self._path}: it is read only here")
