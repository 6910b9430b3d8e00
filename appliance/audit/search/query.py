"""Translate filters to SQL. No I/O. Values are always bound as parameters, never part of the statement."""

import ipaddress
from typing import NamedTuple

import msgspec

from appliance.audit.log.log_database import TEXT_OF_RECORD
from appliance.audit.log.record import Severity
from appliance.audit.log.repetition import OTHERS
from appliance.audit.search.equality import FOLDED

IN_NETWORKS = "in_networks"
"""A function of SQL that `search` defines: whether a host is in one of the networks, which spaces separate."""
_LONGEST_PATTERN = 256
_MAX_STARS = 8
_TRIGRAM = 3
_MAPPED_PREFIX = 96  # bits before the IPv4 address in ::ffff:10.0.0.1


class FilterError(ValueError):
    """A filter is invalid."""


class Filter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The properties of the records to find; None or empty: any.

    `since` (inclusive) and `until` (exclusive) are nanoseconds since the epoch; `severity` is the minimum.
    Names may be globs. `without_looks` omits allowed REST calls that only read. `host` may also be an address in any
    form, or a network; `hosts` are networks: the meaning of a host's name.
    """

    decision: tuple[str, ...] = ()
    since: int | None = None
    until: int | None = None
    host: str | None = None
    caller_id: str | None = None
    resource: str | None = None
    category: str | None = None
    event: str | None = None
    severity: Severity | None = None
    rule: str | None = None
    text: str | None = None
    who: str | None = None
    without_looks: bool = False
    hosts: tuple[str, ...] = ()


# Records with a damaged detail have no author, and count no name.
_DETAIL = "CASE WHEN json_valid(CAST(detail AS TEXT)) THEN CAST(detail AS TEXT) END"
_WHO = f"json_extract({_DETAIL}, '$.who')"
_TALLIES = {"host": "hosts", "caller_id": "callers", "resource": "resources"}
"""The columns that a summary of several kinds lacks, and the names in its details."""
# A record of a read has the method in its details, even if the read was only counted. The details escape quotes.
_NO_LOOK = """NOT (
    category IS NOT NULL AND category = 'rest' AND decision IS NOT NULL AND decision = 'allow' AND (
        CAST(detail AS TEXT) LIKE '%"method":"GET"%' OR CAST(detail AS TEXT) LIKE '%"method":"HEAD"%'))"""


def network_of(host: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network | None:
    """Return the network of an address or network in any form, or None for a name or glob."""
    try:
        found = ipaddress.ip_network(host)
    except ValueError:
        return None
    mapped = found.network_address.ipv4_mapped if isinstance(found, ipaddress.IPv6Network) else None
    if mapped is None or found.prefixlen < _MAPPED_PREFIX:
        return found
    return ipaddress.IPv4Network((mapped, found.prefixlen - _MAPPED_PREFIX))


def with_network(wanted: Filter) -> Filter:
    """Move an address or network in `host` to `hosts`, in the form that records have."""
    network = None if wanted.host is None else network_of(wanted.host)
    return wanted if network is None else msgspec.structs.replace(wanted, host=None, hosts=(str(network),))


class Condition(NamedTuple):
    """A part of a WHERE clause, its values, and the index that can answer it.

    `in_order`: that index lists the records of the condition in the order of the log.
    """

    sql: str
    values: tuple[object, ...]
    answered_by: str | None = None
    in_order: bool = False


def conditions(wanted: Filter) -> list[Condition]:
    """Return the conditions of a filter, except that on its text. Raises `FilterError`."""
    found: list[Condition] = []
    if wanted.decision:
        found.append(_one_of("decision", wanted.decision))
    for column in ("host", "caller_id", "resource", "category", "event"):
        value = getattr(wanted, column)
        if value is not None:
            found.append(_match(column, value))
    if wanted.hosts:
        found.append(_within("host", wanted.hosts))
    if wanted.severity is not None:
        order = list(Severity)
        names = tuple(severity.value for severity in order[order.index(wanted.severity) :])
        found.append(_one_of("severity", names))
    if wanted.rule is not None:
        pattern = checked_pattern("rule", wanted.rule)
        found.append(
            Condition(
                "(rule IS NOT NULL AND (rule GLOB ? OR rule_key GLOB ? OR rule_key = ?))",
                (pattern,) * 3,
                "record_rule",
            )
        )
    if wanted.who is not None:
        found.append(Condition(f"({_WHO}) GLOB ?", (checked_pattern("who", wanted.who),)))
    if wanted.without_looks:
        found.append(Condition(_NO_LOOK, ()))
    if wanted.since is not None:
        found.append(Condition("time >= ?", (wanted.since,), "record_time"))
    if wanted.until is not None:
        found.append(Condition("time < ?", (wanted.until,), "record_time"))
    return found


def counted_conditions(wanted: Filter) -> list[Condition]:
    """Return the conditions of summaries that may count a wanted name; empty if the filter has no such name.

    A summary of several hosts has no field `host`, and counts them in its details; likewise for callers and resources.
    """
    names = {"host": wanted.host, "caller_id": wanted.caller_id, "resource": wanted.resource}
    found = [
        _counts(column, _match(column, name), _match("key", name))
        for column, name in names.items()
        if name is not None
    ]
    if wanted.hosts:
        found.append(_counts("host", _within("host", wanted.hosts), _within("key", wanted.hosts)))
    if not found:
        return []
    others = msgspec.structs.replace(wanted, host=None, hosts=(), caller_id=None, resource=None)
    return [*found, _one_of("event", tuple(sorted(FOLDED))), *conditions(others)]


def _counts(column: str, named: Condition, counted: Condition) -> Condition:
    """Return the condition that the record has the name, or counts it or further names."""
    tally = f"json_each({_DETAIL}, '$.{_TALLIES[column]}') WHERE {counted.sql} OR key = '{OTHERS}'"
    sql = f"({named.sql} OR {column} IS NULL AND EXISTS (SELECT 1 FROM {tally}))"  # noqa: S608  fixed names
    return Condition(sql, named.values + counted.values)


def _one_of(column: str, values: tuple[str, ...]) -> Condition:
    marks = ", ".join("?" * len(values))
    return Condition(f"({column} IN ({marks}) AND {column} IS NOT NULL)", values, f"record_{column}")


def _within(name: str, networks: tuple[str, ...]) -> Condition:
    """Return the condition that a host is in one of the networks; an index has only single addresses."""
    if all(network.endswith(("/32", "/128")) for network in networks):
        return _one_of(name, tuple(network.rpartition("/")[0] for network in networks))
    return Condition(f"({name} IS NOT NULL AND {IN_NETWORKS}({name}, ?))", (" ".join(networks),))


def _match(column: str, value: str) -> Condition:
    value = checked_pattern(column, value)
    operator = "GLOB" if any(sign in value for sign in "*?[") else "="
    present = "" if column == "event" else f" AND {column} IS NOT NULL"
    return Condition(f"({column} {operator} ?{present})", (value,), f"record_{column}", operator == "=")


def checked_pattern(name: str, value: str) -> str:
    """Return the pattern. Raises `FilterError` unless it is short, simple and valid Unicode."""
    if len(value) > _LONGEST_PATTERN:
        raise FilterError(f"{name}: longer than {_LONGEST_PATTERN} characters; give a shorter pattern")
    if value.count("*") > _MAX_STARS:
        raise FilterError(f"{name}: more than {_MAX_STARS} times '*'; give a shorter pattern")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise FilterError(f"{name}: not valid Unicode") from error
    return value


def text_condition(text: str) -> Condition:
    escaped = checked_pattern("text", text).replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")
    return Condition(f"({TEXT_OF_RECORD}) LIKE ? ESCAPE '\\'", (f"%{escaped}%",))


def text_match(text: str) -> str | None:
    """Return a query of the index, which only finds candidates, or None if the text is too short for it."""
    if len(text) < _TRIGRAM or "\0" in text:
        return None
    trigrams = {text[start : start + _TRIGRAM] for start in range(len(text) - _TRIGRAM + 1)}
    return " AND ".join('"' + trigram.replace('"', '""') + '"' for trigram in sorted(trigrams))
