from dataclasses import dataclass
from typing import Any

import msgspec
import pytest

from appliance.audit.log.columns import LARGEST_DETAIL, LONGEST_TEXT, from_columns, plain_record, to_columns
from appliance.audit.log.record import AuditRecord, RuleReference, Severity


def make(**fields: Any) -> AuditRecord:
    return AuditRecord(**{"id": "0" * 20, "time": 1, "event": "decision", **fields})


def test_round_trip() -> None:
    record = make(
        severity=Severity.ALARM, decision="deny", host="10.0.0.1", caller_id="/\x1b[2J\u202e\0é",
        category="call", resource="/a", rule=RuleReference("Clients", "/a", "p.ini", 7), revision=2,
        reason="no", duration_us=9,
        detail={"list": [1, 2.5, None, {"deep": "ü"}]},
    )  # fmt: skip
    assert from_columns(to_columns(record, 1)) == record


class Ended(msgspec.Struct):
    publications: int = 1
    connections: int = 2


@dataclass
class Row:
    publications: int = 1
    connections: int = 2


@pytest.mark.parametrize("value", [Ended(), Row(), [Ended()], {"z": Row(), "a": 1}])
def test_a_record_that_was_read_is_stored_as_the_same_text(value: object) -> None:
    columns = to_columns(make(detail={"ended": value}), 1)
    assert to_columns(from_columns(columns), 1) == columns


@pytest.mark.parametrize(
    "value",
    [
        "\udc80", {"\udc80": 1}, 2**70, -(2**4000), float("nan"), b"\xff\x00", object(), {1: 2}, {(1, 2): 3},
        {1, 2}, "x" * 1_000_000, ["y" * 5000] * 1000, {str(n): n for n in range(10_000)},
        __import__("functools").reduce(lambda inner, _: [inner], range(5000), []),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_any_detail_can_be_stored(value: Any) -> None:
    columns = to_columns(make(detail={"value": value}), 1)
    assert len(columns.detail) <= LARGEST_DETAIL
    assert from_columns(columns).detail


@pytest.mark.parametrize("field", ["host", "caller_id", "category", "resource", "reason", "event"])
def test_texts_are_bounded_and_storable(field: str) -> None:
    assert getattr(from_columns(to_columns(make(**{field: "a\udcffb"}), 1)), field) == "a\\udcffb"
    cut = getattr(from_columns(to_columns(make(**{field: "z" * 100_000}), 1)), field)
    assert len(cut) <= LONGEST_TEXT
    assert cut.endswith("(100000 characters)")


@pytest.mark.parametrize(
    "fields",
    [
        {"time": 2**70}, {"revision": 2**70}, {"duration_us": -(2**70)}, {"host": ["10.0.0.1"]},
        {"severity": "odd"}, {"caller_id": 7}, {"resource": b"/a"}, {"detail": None},
        {"rule": RuleReference("a", "b", "c", 2**70)},
        {"time": None}, {"revision": 1.5},
    ],
    ids=str,
)  # fmt: skip
def test_fields_of_a_wrong_type(fields: dict[str, Any]) -> None:
    columns = to_columns(make(**fields), 1)
    assert all(type(column) in (str, int, bytes, type(None)) for column in columns)
    assert abs(columns.time) < 1 << 63
    assert from_columns(columns).id == "0" * 20


def test_small_details_survive_large_ones() -> None:
    names = [f"monitor_{number}" * 20 for number in range(1000)]
    detail = {
        "sha256": "a" * 64,
        "monitors": names,
        "revision": 7,
        **{f"key{n}": "é" * 300 for n in range(250)},
    }
    columns = to_columns(make(detail=detail), 1)
    kept = from_columns(columns).detail
    assert len(columns.detail) <= LARGEST_DETAIL
    assert (kept["sha256"], kept["revision"]) == ("a" * 64, 7)
    assert "monitors" in kept["keys"]
    assert kept["cut"] == "the details were too large to keep"


def test_long_collections_say_how_many_parts_are_left_out() -> None:
    numbers = list(range(258))
    detail = {"list": numbers, "map": {str(number): number for number in numbers}}
    shown = plain_record(make(detail=detail)).detail
    assert shown["list"] == [*numbers[:256], "... 2 more"]
    assert list(shown["map"].items())[-2:] == [("255", 255), ("...", "2 more")]
    short = {"list": numbers[:256], "map": {"a": 1}}
    assert plain_record(make(detail=short)).detail == short
