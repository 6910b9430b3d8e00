"""Explain a record in a few lines: author, events, values, location in the specification."""

from collections.abc import Iterator

from appliance.audit.record import AuditRecord
from appliance.audit.record_format import rule_text
from rosmop.run.why_text import lines_of_why, list_of, mapping_of


def lines_of(record: AuditRecord) -> Iterator[str]:
    """Yield the lines of the explanation; the caller must escape untrusted text in them."""
    detail = record.detail
    yield record.reason or record.event
    sent = [f"{name} {detail[name]}" for name in ("number", "seq") if name in detail]
    who = [part for part in (record.caller_id, record.host and f"on {record.host}") if part]
    if who or sent:
        message = f"message {', '.join(sent)} of " if sent else ""
        yield f"by: {message}{' '.join(who) or 'unknown'}"
    if record.rule is not None:
        yield f"rule: {rule_text(record.rule)}"
    places = list_of(detail.get("at"))
    if places:
        yield f"at: {', '.join(map(str, places))}"
    if "timer" in detail:
        yield f"timer: {detail['timer']}"
    events = list_of(detail.get("events"))
    if events:
        yield f"events: {', '.join(map(str, events))}"
    for place, values in mapping_of(detail.get("conditions")).items():
        yield f"where: {place}{_valued(values)}"
    if values := _valued(detail.get("values")):
        yield f"with: {values.removeprefix(', ')}"
    if "handler" in detail:
        yield f"in the handler of: {detail['handler']}"
    if "withheld" in detail:
        yield "this role may not read contents of messages"
        return
    yield from lines_of_why(mapping_of(detail.get("why")))
    is_verdict = record.event == "monitor verdict" or detail.get("would") == "verdict" or "handler" in detail
    if is_verdict and "why" not in detail and "count" not in detail:
        yield "because: the causing events are no longer known, or that second had too many verdicts to record them"


def _valued(values: object) -> str:
    return "".join(f", {name} = {value}" for name, value in mapping_of(values).items())
