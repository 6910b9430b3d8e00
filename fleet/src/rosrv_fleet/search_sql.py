"""Translate a search over all robots to SQL. No I/O; each value is a parameter, never a part of the statement.

Pages are ordered by time, robot and id, newest first, and a cursor continues after the last row. Because the robot
comes before the id, a robot cannot hide another's records behind equal ids.
"""

import base64
import binascii
from collections.abc import Collection
from typing import LiteralString, NamedTuple

import msgspec

from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.record import Severity
from appliance.audit.search.query import Filter, FilterError, checked_pattern, network_of

_ORDER: LiteralString = " ORDER BY time DESC, robot DESC, id DESC LIMIT %s"
_WORDS: LiteralString = (
    "(coalesce(host, '') || ' ' || coalesce(caller_id, '') || ' ' || coalesce(resource, '') || ' ' ||"
    " coalesce(rule, '') || ' ' || reason || ' ' || detail)"
)
_COLUMNS: LiteralString = (
    "robot, log, sequence, id, time, version, event, severity, decision, host, caller_id, category, resource, rule,"
    " rule_key, rule_file, rule_line, revision, reason, duration_us, detail"
)
_HEAD: LiteralString = "SELECT " + _COLUMNS + " FROM record"  # noqa: S608  both are constants
assert _COLUMNS.split(", ")[2:] == list(StoredColumns._fields)  # noqa: S101  `StoredColumns` is made from a row


class FleetFilter(NamedTuple):
    """The glob of the robots' names (None for all robots), and the filter of each log."""

    robot: str | None
    record: Filter


class SearchCursor(msgspec.Struct, frozen=True, array_like=True):
    """The key of a page's last row."""

    time: int
    robot: str
    id: str

    def text(self) -> str:
        return base64.urlsafe_b64encode(msgspec.json.encode(self)).decode("ascii")


def parse_cursor(text: str) -> SearchCursor:
    """Return the cursor. Raise `FilterError` if no search made it."""
    try:
        cursor = msgspec.json.decode(base64.urlsafe_b64decode(text), type=SearchCursor)
    except (binascii.Error, ValueError) as error:
        raise FilterError("cursor: not one that a search gave") from error
    if abs(cursor.time) >= 1 << 63 or "\0" in cursor.robot + cursor.id:
        raise FilterError("cursor: not one that a search gave")
    return cursor


class SearchStatement(NamedTuple):
    """A statement with its parameters."""

    text: LiteralString
    values: tuple[object, ...]


class _Conditions:
    def __init__(self) -> None:
        self._found: list[LiteralString] = []
        self._values: list[object] = []

    def add(self, condition: LiteralString, *values: object) -> None:
        self._found.append(condition)
        self._values += values

    def matching(
        self, name: str, equal: LiteralString, glob: LiteralString, value: str | None, times: int = 1
    ) -> None:
        if value is None:
            return
        value = checked_pattern(name, value).replace("\0", "\u2400")
        if any(sign in value for sign in "*?["):
            self.add(glob, *[regex_of(value)] * times)
        else:
            self.add(equal, *[value] * times)

    def statement(self, head: LiteralString, tail: LiteralString, *values: object) -> SearchStatement:
        where: LiteralString = " WHERE " if self._found else ""
        return SearchStatement(head + where + " AND ".join(self._found) + tail, (*self._values, *values))


def days_statement(record: Filter) -> SearchStatement | None:
    """Return the query for the days that a time range covers, or None without a range."""
    if record.since is None and record.until is None:
        return None
    conditions = _Conditions()
    if record.since is not None:
        conditions.add("last_time >= %s", record.since)
    if record.until is not None:
        conditions.add("first_time < %s", record.until)
    return conditions.statement("SELECT DISTINCT day FROM segment", "")


def search_statement(
    wanted: FleetFilter, cursor: SearchCursor | None, limit: int, days: list[object] | None
) -> SearchStatement:
    """Return the query for a page, limited to the partitions `days` unless None. Raise `FilterError`."""
    found, record = _Conditions(), wanted.record
    if days is not None:
        found.add("day = ANY(%s::date[])", days)
    if cursor is not None:
        found.add("(time, robot, id) < (%s, %s, %s)", cursor.time, cursor.robot, cursor.id)
    found.matching("robot", "robot = %s", "robot ~ %s", wanted.robot)
    network = None if record.host is None else network_of(record.host)
    single = network is not None and network.num_addresses == 1
    host = str(network.network_address) if network is not None and single else record.host
    found.matching("host", "host = %s", "host ~ %s", host)
    found.matching("caller", "caller_id = %s", "caller_id ~ %s", record.caller_id)
    found.matching("topic", "resource = %s", "resource ~ %s", record.resource)
    found.matching("category", "category = %s", "category ~ %s", record.category)
    found.matching("event", "event = %s", "event ~ %s", record.event)
    found.matching("who", "who = %s", "who ~ %s", record.who)
    found.matching("rule", "(rule = %s OR rule_key = %s)", "(rule ~ %s OR rule_key ~ %s)", record.rule, 2)
    if len(record.decision) == 1:
        found.add("decision = %s", record.decision[0])
    elif record.decision:
        found.add("decision = ANY(%s)", list(record.decision))
    if record.severity is not None:
        order = list(Severity)
        found.add("severity = ANY(%s)", [one.value for one in order[order.index(record.severity) :]])
    if record.text is not None:
        found.add(_WORDS + " ILIKE %s", f"%{_escape(checked_pattern('text', record.text))}%")
    if record.since is not None:
        found.add("time >= %s", record.since)
    if record.until is not None:
        found.add("time < %s", record.until)
    return found.statement(_HEAD, _ORDER, limit)


def records_statement(events: Collection[str], robot: str | None) -> SearchStatement:
    """Return the query for all records of some events, in the order of each robot's logs. Raise `FilterError`."""
    conditions = _Conditions()
    conditions.add("event = ANY(%s)", list(events))
    conditions.matching("robot", "robot = %s", "robot ~ %s", robot)
    return conditions.statement(_HEAD, " ORDER BY robot, log, sequence")


def logs_statement(robot: str | None) -> SearchStatement:
    """Return the query for all logs: robot, log, last record, times, and first record. Raise `FilterError`."""
    conditions = _Conditions()
    conditions.matching("robot", "robot = %s", "robot ~ %s", robot)
    head: LiteralString = (
        "SELECT robot, log, max(last), min(first_time), min(first), max(last_time) FROM segment"
    )
    return conditions.statement(head, " GROUP BY robot, log ORDER BY robot, log")


def _escape(text: str) -> str:
    return text.replace("\0", "\u2400").replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")


def regex_of(glob: str) -> str:
    """Translate a pattern of SQLite's GLOB to a regular expression of PostgreSQL. Raise `FilterError`."""
    parts, at = ["^"], 0
    while at < len(glob):
        sign = glob[at]
        at += 1
        if sign == "*":
            parts.append(".*")
        elif sign == "?":
            parts.append(".")
        elif sign == "[":
            negated = glob[at : at + 1] == "^"
            begin = at + negated
            end = glob.find("]", begin + 1)  # a first ']' belongs to the set
            if end < 0:
                raise FilterError(f"{glob!a}: '[' has no ']'")
            inside = "".join(f"\\{one}" if one in "\\[]^" else one for one in glob[begin:end])
            parts.append(f"[{'^' if negated else ''}{inside}]")
            at = end + 1
        else:
            parts.append(f"\\{sign}" if sign in "\\.+(){}|^$" else sign)
    return "".join([*parts, "$"])
