"""Tests of the documented form of a record."""

from pathlib import Path

from appliance.audit.chain_proofs import Chain
from appliance.audit.events import EVENTS
from appliance.audit.record import Record, RuleReference
from appliance.audit.record_format import Entry, as_object
from appliance.audit.schema import json_schema
from distribution.audit_record_page import CHAIN, markdown

_PAGE = Path(__file__).parents[3] / "docs" / "audit.md"


def test_page_is_what_the_code_says() -> None:
    """The reviewer's page has the fields, events and schema of the code (python -m distribution.audit_record_page)."""
    generated = _PAGE.read_text().split("<!-- generated: python -m distribution.audit_record_page -->\n")[1]
    assert generated == markdown()


def test_every_field_is_documented() -> None:
    """The JSON of a record has the fields of the schema, in its order, and no others."""
    rule = RuleReference("Publishers", "/**", "a.ini", 1)
    full = as_object(Entry(1, Record(id="0" * 20, time=1, event="decision", decision="deny", rule=rule)))
    schema = json_schema()
    assert list(full) == list(schema["properties"])
    bare = as_object(Entry(1, Record(id="0" * 20, time=1, event="decision")))
    assert list(bare) == schema["required"]
    assert list(full["rule"]) == schema["properties"]["rule"]["required"]


def test_a_line_of_an_export_is_a_record_and_its_place() -> None:
    """The documented place in the chain has the fields that are written."""
    assert list(CHAIN["properties"]) == list(Chain.__struct_fields__)


def test_events_are_described() -> None:
    """Every event has a name in lower-case words and a sentence."""
    for name, text in EVENTS.items():
        assert name == name.lower().strip()
        assert text.endswith(".")
        assert "|" not in text
