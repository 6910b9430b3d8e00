import re
import sqlite3
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosrv_fleet.search_sql import FleetFilter, SearchCursor, parse_cursor, regex_of, search_statement

from appliance.audit.search.query import Filter, FilterError

_HOSTILE = "'; DROP TABLE record; -- %s"


@given(glob=st.text("ab]^[*?-\\.$", max_size=8), text=st.text("ab]^[-\\.$\n", max_size=6))
def test_a_glob_matches_what_sqlite_matches(glob: str, text: str) -> None:
    try:
        regex = regex_of(glob)
        if "-" in glob:
            return  # ranges that run backwards differ; PostgreSQL refuses them, and Python warns of some
        pattern = re.compile(regex, re.DOTALL)
    except (FilterError, re.error):
        return
    found = bool(pattern.fullmatch(text))
    connection = sqlite3.connect(":memory:")
    (expected,) = connection.execute("SELECT ? GLOB ?", (text, glob)).fetchone()
    connection.close()
    assert found == bool(expected)


def _filters() -> Iterator[FleetFilter]:
    for field in ("host", "caller_id", "resource", "category", "event", "rule", "text", "who"):
        for value in (_HOSTILE, f"{_HOSTILE}*"):
            yield FleetFilter(None, Filter(**{field: value}))  # type: ignore[arg-type]  # each is a text
    yield FleetFilter(_HOSTILE, Filter(decision=(_HOSTILE,)))
    yield FleetFilter(f"{_HOSTILE}?", Filter(decision=(_HOSTILE, _HOSTILE)))


@pytest.mark.parametrize("wanted", list(_filters()))
def test_input_is_never_part_of_a_statement(wanted: FleetFilter) -> None:
    statement = search_statement(wanted, SearchCursor(1, _HOSTILE, _HOSTILE), 10, [_HOSTILE])
    assert "DROP" not in statement.text
    assert statement.text.count("%s") == len(statement.values)


@pytest.mark.parametrize("host", ["FD00:0::1", "fd00::1", "fd00::1/128"])
def test_an_address_is_compared_as_records_have_it(host: str) -> None:
    assert search_statement(FleetFilter(None, Filter(host=host)), None, 10, None).values == ("fd00::1", 10)


@pytest.mark.parametrize("text", ["", "x", "!!!!", "W10=", "WzEsMiwzXQ==", "é"])
def test_a_forged_cursor_is_refused(text: str) -> None:
    with pytest.raises(FilterError):
        parse_cursor(text)
    assert parse_cursor(SearchCursor(5, "arm", "x").text()) == SearchCursor(5, "arm", "x")
