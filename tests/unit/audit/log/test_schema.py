from appliance.audit.log.events import EVENTS
from appliance.audit.log.record import AuditRecord, RuleReference
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.log.schema import json_schema
from appliance.audit.proof.chain_proofs import ChainProof
from distribution.generated_pages import CHAIN


def test_every_field_is_documented() -> None:
    rule = RuleReference("Publishers", "/**", "a.ini", 1)
    full = as_object(
        LogEntry(1, AuditRecord(id="0" * 20, time=1, event="decision", decision="deny", rule=rule))
    )
    schema = json_schema()
    assert list(full) == list(schema["properties"])
    bare = as_object(LogEntry(1, AuditRecord(id="0" * 20, time=1, event="decision")))
    assert list(bare) == schema["required"]
    assert list(full["rule"]) == schema["properties"]["rule"]["required"]


def test_a_line_of_an_export_is_a_record_and_its_position() -> None:
    assert list(CHAIN) == list(ChainProof.__struct_fields__)


def test_events_are_described() -> None:
    for name, text in EVENTS.items():
        assert name == name.lower().strip()
        assert text.endswith(".")
        assert "|" not in text
