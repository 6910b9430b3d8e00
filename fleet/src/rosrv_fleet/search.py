"""Search the index of all robots."""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import psycopg
from psycopg_pool import PoolTimeout

from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.record_format import as_object, stored_entry
from appliance.audit.search.query import FilterError
from appliance.base.counted import counted
from rosrv_fleet.database import IndexDatabase, is_complete
from rosrv_fleet.search_sql import FleetFilter, SearchCursor, days_statement, parse_cursor, search_statement

LARGEST_FLEET_PAGE = 1000


class SearchTooLongError(Exception):
    """A search took longer than its limit."""


class IndexDownError(Exception):
    """The database cannot be reached, or all connections are in use."""


class TooManySearchesError(Exception):
    """The limit of simultaneous searches is reached, for this token or in total."""


class Searches:
    """The database of searches, and the limit of simultaneous ones. One token gets at most half of it. Thread-safe."""

    def __init__(self, database: IndexDatabase, most: int) -> None:
        self.database = database
        self._most = most
        self._lock = threading.Lock()
        self._running: Counter[str] = Counter()

    @contextmanager
    def turn(self, token: str) -> Iterator[IndexDatabase]:
        with self._lock:
            if self._running[token] >= max(1, self._most // 2):
                raise TooManySearchesError(
                    f"the token {token} has {counted(self._running[token], 'search')} running: wait for them"
                )
            if self._running.total() >= self._most:
                raise TooManySearchesError(f"{self._most} searches are running: try again")
            self._running[token] += 1
        try:
            yield self.database
        finally:
            with self._lock:
                self._running[token] -= 1
                if not self._running[token]:
                    del self._running[token]


class FleetPage(msgspec.Struct, frozen=True, kw_only=True):
    """A page of records, newest first, each with its `robot` and `log`, and the cursor of the next page.

    `waiting` segments, counted up to 1,000, are not indexed yet, so the search misses them. If the index is not
    `complete`, it misses others until `rosrv-fleet reindex` has ended.
    """

    records: list[dict[str, Any]]
    cursor: str | None
    waiting: int
    complete: bool


def search_fleet(
    database: IndexDatabase, wanted: FleetFilter, cursor: str | None, limit: int, waiting: int
) -> FleetPage:
    """Return a page of matching records. Raise `FilterError`, `SearchTooLongError` or `IndexDownError`."""
    after = None if cursor is None else parse_cursor(cursor)
    try:
        rows, complete = _rows(database, wanted, after, limit + 1)
    except psycopg.errors.QueryCanceled as error:
        raise SearchTooLongError(
            "the search took too long: give a shorter time with since and until, or an exact name"
        ) from error
    except psycopg.errors.InvalidRegularExpression as error:
        raise FilterError("a glob has a set such as [z-a] that matches nothing") from error
    except (psycopg.OperationalError, PoolTimeout, psycopg.errors.UndefinedTable) as error:
        raise IndexDownError(
            "the index cannot be searched now: try again; segments are still stored"
        ) from error
    records = [_record(row) for row in rows[:limit]]
    last = rows[limit - 1] if len(rows) > limit else None
    more = None if last is None else SearchCursor(last[4], last[0], last[3]).text()
    return FleetPage(records=records, cursor=more, waiting=waiting, complete=complete)


def _rows(
    database: IndexDatabase, wanted: FleetFilter, after: SearchCursor | None, limit: int
) -> tuple[list[tuple[Any, ...]], bool]:
    with database.reading() as connection:
        of_days, days = days_statement(wanted.record), None
        if of_days is not None:
            days = [day for (day,) in connection.execute(*of_days)]
        statement = search_statement(wanted, after, limit, days)
        rows = [] if days == [] else connection.execute(*statement).fetchall()  # no day would lock all
        return rows, is_complete(connection)


def _record(row: tuple[Any, ...]) -> dict[str, Any]:
    robot, log, *columns = row
    return {"robot": robot, "log": log} | as_object(stored_entry(StoredColumns._make(columns)))
