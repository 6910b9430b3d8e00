"""Read the log: search with paging, show a record with its neighbours, follow, export.

Reading never blocks the writer. Texts are also searched in the records that are not indexed yet.
"""

import functools
import ipaddress
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple, TypeVar

from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.ids import ID_LENGTH
from appliance.audit.log.log_database import COLUMNS, LogUnreadableError, open_for_reading, reading
from appliance.audit.log.log_queries import record_extent
from appliance.audit.log.record_format import LogEntry, stored_entry
from appliance.audit.search.equality import FOLDED, equal_key
from appliance.audit.search.query import (
    IN_NETWORKS,
    Condition,
    Filter,
    FilterError,
    conditions,
    counted_conditions,
    text_condition,
    text_match,
    with_network,
)

LARGEST_PAGE = 10_000
_SELECTIVE = 20_000
_BEFORE_A_COUNT = 200  # records; a monitor's count is at most a second later than its record in full
_Found = TypeVar("_Found")


class SearchPage(NamedTuple):
    """A page of records; `cursor` begins the next page, and is None at the end."""

    entries: list[LogEntry]
    cursor: str | None


class RecordInContext(NamedTuple):
    """A record, and the records of the same host or caller before and after it."""

    entry: LogEntry
    before: list[LogEntry]
    after: list[LogEntry]


def search(
    path: Path, wanted: Filter, cursor: str | None = None, limit: int = 100, *, newest_first: bool = True
) -> SearchPage:
    """Return a page of the records found. Raises `LogUnreadableError` and `FilterError`."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise FilterError(f"limit: must be 1 to {LARGEST_PAGE}")
    walk = _Walk(_sequence(cursor), newest_first)
    return _reading(path, lambda connection: _page(connection, wanted, walk, limit))


def show(path: Path, record_id: str, neighbours: int = 5) -> RecordInContext | None:
    """Return the record with this id or sequence, or None."""

    def find(connection: sqlite3.Connection) -> RecordInContext | None:
        column = "id" if len(record_id) == ID_LENGTH else "sequence"
        if column == "sequence" and not (record_id.isascii() and record_id.isdecimal()):
            return None
        value = record_id if column == "id" else min(int(record_id[:19]), (1 << 63) - 1)
        entries = _fetch(connection, f"WHERE {column} = ? LIMIT 1", (value,))
        if not entries:
            return None
        return RecordInContext(
            entries[0],
            _neighbours(connection, entries[0], neighbours, newest_first=True)[::-1],
            _neighbours(connection, entries[0], neighbours, newest_first=False),
        )

    return _reading(path, find)


def export(path: Path, wanted: Filter, page: int = 1000, *, newest_first: bool = False) -> Iterator[LogEntry]:
    """Yield all records found. Raises `LogUnreadableError` and `FilterError`."""
    cursor = None if newest_first else "0"
    while True:
        entries, cursor = search(path, wanted, cursor, page, newest_first=newest_first)
        yield from entries
        if cursor is None:
            return


class LogSnapshot:
    """An unchanging view of the log, for a report that reads it in several steps.

    Its methods raise `LogUnreadableError`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._opened = ExitStack()
        self._connection = self._opened.enter_context(reading(path))
        self._connection.execute("BEGIN").execute(
            "SELECT count(*) FROM sqlite_schema"
        )  # the log as it is now

    def close(self) -> None:
        self._opened.close()

    def of_events(self, events: Collection[str], page: int = 500) -> Iterator[LogEntry]:
        """Yield the records of some events, oldest first.

        Their sequences come from an index, so a year's ten million other records are not read.
        """
        marks = ", ".join("?" * len(events))
        found = self._connection.execute(
            f"SELECT sequence FROM record INDEXED BY record_event WHERE event IN ({marks}) ORDER BY sequence",  # noqa: S608  question marks
            tuple(events),
        )
        while sequences := [sequence for (sequence,) in found.fetchmany(page)]:
            places = ", ".join("?" * len(sequences))
            yield from self._read(f"WHERE sequence IN ({places}) ORDER BY sequence", *sequences)

    def following(self, event: str, sequence: int) -> Iterator[LogEntry]:
        """Yield the records of an event after this sequence; the next one is read when it is wanted."""
        tail = "INDEXED BY record_event WHERE event = ? AND sequence > ? ORDER BY sequence"
        return self._read(tail, event, sequence)

    def _read(self, tail: str, *values: object) -> Iterator[LogEntry]:
        try:
            yield from _rows(self._connection, tail, values)
        except (sqlite3.Error, ValueError, TypeError, RecursionError, MemoryError) as error:
            raise LogUnreadableError(
                f"{self._path}: cannot be read: {error}; run 'rosrv audit verify'"
            ) from error


def last_sequence(path: Path) -> int:
    _first, last = _reading(path, record_extent)
    return last


def recorded_in_full(path: Path, entry: LogEntry) -> LogEntry | None:
    """Return the first of the records that this one counts, if the log has it. Raises `LogUnreadableError`."""
    record = entry.record
    if record.event in FOLDED:
        shown = show(path, str(record.detail.get("recorded_id", "")), 0)
        return None if shown is None else shown.entry
    if not ("count" in record.detail and "monitor" in record.detail):
        return None
    wanted = Filter(event=record.event, category=record.category)
    page = search(path, wanted, str(entry.sequence), _BEFORE_A_COUNT)
    key = equal_key(record)
    earlier = (one for one in page.entries if "count" not in one.record.detail)
    return next((one for one in earlier if key.equals(equal_key(one.record))), None)


class Follower:
    """Each `poll` returns the records since the previous one, oldest first."""

    def __init__(self, path: Path, wanted: Filter, after: int | None = None) -> None:
        """Begin after this sequence, by default at the end of the log. Raises `FilterError`."""
        conditions(wanted)  # an invalid filter is refused now, not at the first record
        if wanted.text:
            text_condition(wanted.text)
        self._path = path
        self._wanted = wanted
        self._after = last_sequence(path) if after is None else after

    @property
    def position(self) -> int:
        return self._after

    def poll(self, limit: int = 1000) -> list[LogEntry]:
        head = last_sequence(self._path)
        if head <= self._after:
            self._after = min(self._after, head)
            return []
        entries, more = search(self._path, self._wanted, str(self._after), limit, newest_first=False)
        self._after = (
            entries[-1].sequence if more is not None else max(head, *(e.sequence for e in entries), 0)
        )
        return entries


class _Walk(NamedTuple):
    """The start of a page (exclusive), and its direction."""

    start: int | None
    newest_first: bool

    @property
    def order(self) -> str:
        return "DESC" if self.newest_first else "ASC"

    def condition(self, column: str) -> list[Condition]:
        if self.start is None:
            return []
        return [Condition(f"{column} {'<' if self.newest_first else '>'} ?", (self.start,))]


def _sequence(cursor: str | None) -> int | None:
    if cursor is None:
        return None
    if not (cursor.isdecimal() and cursor.isascii() and len(cursor) <= 18):
        raise FilterError("cursor: not one that a search printed; leave it out to begin at the first page")
    return int(cursor)


def _reading(path: Path, read: Callable[[sqlite3.Connection], _Found]) -> _Found:
    try:
        with closing(open_for_reading(path)) as connection:
            connection.execute("BEGIN")
            return read(connection)
    except FilterError:
        raise
    except (sqlite3.Error, ValueError, TypeError, RecursionError, MemoryError) as error:
        raise LogUnreadableError(f"{path}: cannot be read: {error}; run 'rosrv audit verify'") from error


def _page(connection: sqlite3.Connection, wanted: Filter, walk: _Walk, limit: int) -> SearchPage:
    wanted = with_network(wanted)
    found = conditions(wanted)
    if wanted.hosts:
        connection.create_function(IN_NETWORKS, 2, _in_networks, deterministic=True)
    index = _most_selective(connection, found)
    if index is None and not wanted.text:  # a search for a text has an index of its own
        index = _in_order(found)
    texts = [text_condition(wanted.text)] if wanted.text else []
    words = text_match(wanted.text) if wanted.text and index is None else None
    if words is None:
        entries = _select(connection, found + texts + walk.condition("sequence"), index, walk, limit + 1)
    else:
        entries = _select_by_text(connection, found + texts, words, walk, limit + 1)
    if counted := counted_conditions(wanted):
        index = _most_selective(connection, counted) or "record_event"
        counts = _select(connection, counted + texts + walk.condition("sequence"), index, walk, limit + 1)
        both = {entry.sequence: entry for entry in entries + counts}
        entries = [both[sequence] for sequence in sorted(both, reverse=walk.newest_first)][: limit + 1]
    if len(entries) <= limit:
        return SearchPage(entries, None)
    return SearchPage(entries[:limit], str(entries[limit - 1].sequence))


def _in_networks(host: object, networks: str) -> bool:
    try:
        address = ipaddress.ip_address(str(host))
    except ValueError:
        return False
    return any(address in network for network in _networks_of(networks))


@functools.lru_cache(8)
def _networks_of(text: str) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]:
    return tuple(map(ipaddress.ip_network, text.split()))


def _most_selective(connection: sqlite3.Connection, found: list[Condition]) -> str | None:
    """Return the index with the fewest candidates, or None if all have `_SELECTIVE` or more."""
    best, fewest = None, _SELECTIVE
    for condition in found:
        if condition.answered_by is not None:
            count = connection.execute(
                f"SELECT count(*) FROM (SELECT 1 FROM record INDEXED BY {condition.answered_by}"  # noqa: S608  fixed names
                f" WHERE {condition.sql} LIMIT ?)",
                (*condition.values, fewest),
            ).fetchone()[0]
            if count < fewest:
                best, fewest = condition.answered_by, count
    return best


def _in_order(found: list[Condition]) -> str | None:
    """Return an index that lists its candidates in the order of the log, so that a page reads no others."""
    return next((condition.answered_by for condition in found if condition.in_order), None)


def _select(
    connection: sqlite3.Connection, found: list[Condition], index: str | None, walk: _Walk, limit: int
) -> list[LogEntry]:
    hint = "NOT INDEXED" if index is None else f"INDEXED BY {index}"
    tail = f"ORDER BY sequence {walk.order} LIMIT ?"
    return _fetch(connection, f"{hint} {_where(found)} {tail}", (*_values(found), limit))


def _select_by_text(
    connection: sqlite3.Connection, found: list[Condition], words: str, walk: _Walk, limit: int
) -> list[LogEntry]:
    (through,) = connection.execute("SELECT through FROM indexed").fetchone()
    entries: list[LogEntry] = []
    for indexed in (False, True) if walk.newest_first else (True, False):
        left = limit - len(entries)
        if left and indexed:
            entries += _candidates(connection, found, words, walk, left)
        elif left:
            rest = [*found, *walk.condition("sequence"), Condition("sequence > ?", (through,))]
            entries += _select(connection, rest, None, walk, left)
    return entries


def _candidates(
    connection: sqlite3.Connection, found: list[Condition], words: str, walk: _Walk, limit: int
) -> list[LogEntry]:
    matching = [Condition("words MATCH ?", (words,)), *walk.condition("words.rowid"), *found]
    return _fetch(
        connection,
        f"{_where(matching)} ORDER BY words.rowid {walk.order} LIMIT ?",
        (*_values(matching), limit),
        "words CROSS JOIN record ON record.sequence = words.rowid",
    )


def _neighbours(
    connection: sqlite3.Connection, entry: LogEntry, count: int, *, newest_first: bool
) -> list[LogEntry]:
    walk = _Walk(entry.sequence, newest_first)
    near: dict[int, LogEntry] = {}
    for column in ("host", "caller_id"):
        value = getattr(entry.record, column)
        if value is not None:
            same = [Condition(f"{column} = ?", (value,)), *walk.condition("sequence")]
            near |= {row.sequence: row for row in _select(connection, same, f"record_{column}", walk, count)}
    return [near[sequence] for sequence in sorted(near, reverse=newest_first)][:count]


def _where(found: list[Condition]) -> str:
    return "WHERE " + " AND ".join(condition.sql for condition in found) if found else ""


def _values(found: list[Condition]) -> tuple[object, ...]:
    return tuple(value for condition in found for value in condition.values)


def _fetch(
    connection: sqlite3.Connection, tail: str, values: tuple[object, ...], table: str = "record"
) -> list[LogEntry]:
    return list(_rows(connection, tail, values, table))


def _rows(
    connection: sqlite3.Connection, tail: str, values: tuple[object, ...], table: str = "record"
) -> Iterator[LogEntry]:
    rows = connection.execute(f"SELECT {COLUMNS} FROM {table} {tail}", values)  # noqa: S608  fixed names
    return map(stored_entry, map(StoredColumns._make, rows))
