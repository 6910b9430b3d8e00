"""The page that searches the records of all robots."""

from collections.abc import Mapping, Sequence
from typing import Any

from appliance.audit.search.filter_options import filter_given
from appliance.audit.search.query import FilterError
from appliance.base.timestamps import TimestampError, parse_timestamp
from rosrv_fleet.collector import Collector
from rosrv_fleet.console.frame import Column, alert, badge, choice, field, link, local_time, row, table, text
from rosrv_fleet.evidence.store import StoredEvidence
from rosrv_fleet.search import (
    FleetPage,
    IndexDownError,
    SearchTooLongError,
    TooManySearchesError,
    search_fleet,
)
from rosrv_fleet.search_routes import MOST_WAITING
from rosrv_fleet.search_sql import FleetFilter

WORDS = ("robot", "host", "caller", "topic", "event", "rule", "text", "who", "since", "until")
ASKED = (*WORDS, "decision", "cursor")
_DECISIONS = (
    ("", "any"),
    ("deny", "denied"),
    ("allow", "allowed"),
    ("would_deny", "would be denied"),
    ("ask", "waited for approval"),
)
_ROWS = 100
_COLUMNS = tuple(
    map(
        Column,
        ("Time", "Robot", "Decision", "Event", "Host", "Caller", "Resource", "Reason", "Evidence"),
    )
)


def search_page(collector: Collector, viewer: str, asked: Mapping[str, str]) -> str:
    result = _result(collector, viewer, asked) if any(asked.values()) else ""
    return "<h1>Search</h1>" + _form(asked) + result


def _form(asked: Mapping[str, str]) -> str:
    fields = "".join(field(name, asked[name]) for name in WORDS)
    return (
        f'<form class="filter" action="/search" role="search" aria-label="Records">{fields}'
        + choice("decision", "decision", _DECISIONS, asked["decision"])
        + "<button>Search</button></form>"
    )


def _result(collector: Collector, viewer: str, asked: Mapping[str, str]) -> str:
    words: dict[str, Any] = {name: asked[name] or None for name in WORDS if name != "robot"}
    if asked["decision"] in dict(_DECISIONS) and asked["decision"]:
        words[asked["decision"]] = True
    try:
        wanted = FleetFilter(asked["robot"] or None, filter_given(**words))
        with collector.searches.turn(viewer) as database:
            waiting = collector.store.waiting(MOST_WAITING)
            found = search_fleet(database, wanted, asked["cursor"] or None, _ROWS, waiting)
    except (FilterError, TimestampError, SearchTooLongError, IndexDownError, TooManySearchesError) as error:
        return alert(str(error))
    return _shown(found, asked, collector.evidence.all())


def _shown(found: FleetPage, asked: Mapping[str, str], bundles: Sequence[StoredEvidence]) -> str:
    more = ""
    if found.cursor is not None:
        more = f'<p class="pages">{link("/search", "Older records", **{**asked, "cursor": found.cursor})}</p>'
    missing = ""
    if found.waiting:
        missing = alert(f"{found.waiting:,} stored segments are not indexed yet: this search misses them.")
    rows = (_record(record, bundles) for record in found.records)
    return missing + table("Records", _COLUMNS, rows, "No record matches.") + more


def _record(record: dict[str, Any], bundles: Sequence[StoredEvidence]) -> str:
    decision = str(record.get("decision") or "")
    covering = next((one.id for one in bundles if one.has(record)), None)
    words = (record["event"], record["host"], record["caller_id"], record["resource"], record["reason"])
    return row(
        _COLUMNS,
        (
            text(local_time(parse_timestamp(record["time"], 0), 3)),
            text(record["robot"]),
            badge("bad" if decision == "deny" else "plain", decision) if decision else "",
            *(text(word or "") for word in words),
            "" if covering is None else link("/evidence", covering[:12], id=covering),
        ),
    )
