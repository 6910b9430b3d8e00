"""Explain decisions, records and denials, and judge texts, without RVMaster.

Every function is pure and runs in a thread, so a client's long text costs RVMaster nothing. If `text` is None,
the policy in force, `current`, is used.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from appliance.api.front.problems import ProblemError
from appliance.audit.log.events import MONITOR_ACTIONS
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339, rule_text
from appliance.audit.log.repetition import KIND
from appliance.base.actors import actor
from appliance.base.counted import counted
from appliance.channel.answers.policy_answers import Granted, PolicyKnown, Why
from appliance.channel.messages.relay_link import NO_GRANT
from appliance.features.policy_tools.decision_reasons import DecisionExplanation, explain
from appliance.features.policy_tools.dry_run_policy import refused_text
from appliance.features.policy_tools.grant import NO_DECISION, DecidedRequest, UngrantableError, asked, grant
from appliance.features.policy_tools.stock_tools import stock_tool
from appliance.policy.actions import BadWordError, check_resource, find_host
from appliance.policy.commands import CALLS
from appliance.policy.host_names import HostInWords
from appliance.policy.judgement import PolicyContext, PolicyJudgement, judge
from appliance.policy.model import Category, Request
from appliance.policy.policy_findings import PolicyError
from appliance.policy.policy_settings import AT_ONCE
from appliance.policy.rights import needs_node
from rosmop.run.why_lines import lines_of_why

# Derive the denied request from the record of a denial, or the reason why no policy would allow the request.

_ASKS = {"topic": "requestTopic", "service": "lookupService"}
"""The calls that grant a connection, by category."""


def is_denial(record: AuditRecord) -> bool:
    return record.event in DENIALS and record.decision != "allow"


def asks_policy(record: AuditRecord) -> bool:
    try:
        return is_denial(record) and asked_of(record) is not None
    except UngrantableError:
        return False


def asked_of(record: AuditRecord) -> DecidedRequest:
    what = DENIALS.get(record.event)
    if what is None:
        raise UngrantableError(NO_DECISION)
    if isinstance(what, str):
        raise UngrantableError(f"no change of the policy would allow it: {what}")
    if record.rule is None and record.reason.startswith(f"{record.host} is blocked by "):  # `Policy.block_of`
        raise UngrantableError(
            "an operator's block denied it, not the policy; if the block is still in force (rosrv host blocks),"
            f" lift it: rosrv host unblock {record.host}"
        )
    return what(record)


def _of_decision(record: AuditRecord) -> DecidedRequest:
    found = asked(
        record.host or "", record.caller_id or "", record.category or "", record.resource or "", record.detail
    )
    return replace(found, takeover=AT_ONCE in record.reason)


def _of_revoked(record: AuditRecord) -> DecidedRequest:
    call = str(record.detail.get("call", ""))
    if not call:
        raise UngrantableError(
            "no change of the policy would have kept it: it was revoked for its recorded reason"
            " (or by an earlier version, whose records do not have the call that gave it)"
        )
    return _of_call(record, call)


def _of_connection(record: AuditRecord) -> DecidedRequest:
    call = _ASKS.get(record.category or "")
    if call is None or not record.reason.startswith(NO_GRANT) or record.decision is None:
        raise UngrantableError(
            "no change of the policy would allow it: the reason of the record says what to correct"
        )
    return _of_call(record, call)


def _of_call(record: AuditRecord, call: str) -> DecidedRequest:
    category, detail = CALLS[call].category, {**record.detail, "call": call}
    resource = record.resource
    if category is Category.COMMAND:
        resource, detail["key"] = call, record.resource
    return _of_decision(
        msgspec.structs.replace(record, category=category.value, resource=resource, detail=detail)
    )


def _of_folded(record: AuditRecord) -> DecidedRequest:
    detail = record.detail
    if detail.get("scope") != KIND:
        raise UngrantableError(
            f"it counts denials of many kinds; the first of them is record {detail.get('recorded_id')}"
        )
    return asked_of(msgspec.structs.replace(record, event=str(detail.get("of")), decision="deny"))


def _of_limited(record: AuditRecord) -> DecidedRequest:
    line = "a line of [Limits] that no longer exists" if record.rule is None else rule_text(record.rule)
    raise UngrantableError(f"no right is missing; more would pass with a higher limit at {line}")


DENIALS: dict[str, str | Callable[[AuditRecord], DecidedRequest]] = {
    "decision": _of_decision,
    "revoked": _of_revoked,
    "connection refused": _of_connection,
    "denials folded": _of_folded,
    "rate limited": _of_limited,
    "limit exceeded": "the bounds on what one peer may send, hold and open are settings"
    " (docs/reference/generated/quotas.md)",
    "malformed": "the data did not follow the protocol; the reason of the record says how",
    "message dropped": "the monitor dropped it; change its specification, or disable it (rosrv monitor disable)",
    "publication refused": "the specifications in force are for another type definition; load specifications for this"
    " one, or give the node theirs",
    "policy refused": "the policy itself was rejected; its findings say why",
    "specifications refused": "the specifications were rejected; their findings say why",
    "order refused": "tokens, their roles (rosrv token list) and signatures decide on REST, not the policy",
    "rest call": "tokens and their roles (rosrv token list) decide on REST, not the policy",
    "authority refused": "[Authority] and the present holder decide it (rosrv drive status)",
    "sign-on refused": "the provider and `sso.roles` decide who signs on",
    "door entry refused": "a valid ticket (rosrv door ticket NAME) or the address of its agent opens a door",
    "enrolment refused": "enrolment needs a valid one-time token (rosrv host add)",
    "renewal refused": "a host renews its certificate in its own tunnel",
    "tunnel refused": "a tunnel needs a valid certificate of this appliance (rosrv host list)",
    "packets refused": "replayed packets, and packets with the address of another host, are never accepted",
}
"""By event, the function that derives the request from a record, or the reason why no policy would allow it.

Every event that can be a denial has an entry.
"""


# Explain a record in a few lines: author, events, values, location in the specification, recording.

_TALLIES = ("reasons", "hosts", "callers", "resources", "calls")
"""The counts by name in a summary of repetitions (`repetition.py`)."""


def lines_of(
    record: AuditRecord, in_full: LogEntry | None = None, host_in_words: Callable[[str], str] = str
) -> Iterator[str]:
    """The caller must escape untrusted text. `in_full` is the first event, if this record counts repetitions."""
    yield from _own_lines(record, host_in_words)
    yield from _counted(record.detail, host_in_words)
    if in_full is not None:
        yield f"the first, in full: record {in_full.sequence}, {rfc3339(in_full.record.time)}"
        yield from (f"  {line}" for line in lines_of(in_full.record, None, host_in_words))


def _counted(detail: Mapping[str, Any], host_in_words: Callable[[str], str]) -> Iterator[str]:
    if "count" not in detail:
        return
    if "monitor" in detail:
        yield f"monitor: {detail['monitor']}"
    times = [
        rfc3339(time) for name in ("first_time", "last_time") if isinstance(time := detail.get(name), int)
    ]
    yield f"counted: {detail['count']}{f', {times[0]} to {times[-1]}' if times else ''}"
    for what in _TALLIES:
        if found := _mapping(detail.get(what)):
            names = {
                host_in_words(name) if what == "hosts" else name: number for name, number in found.items()
            }
            tallies = [f"{name} ({counted(number, 'time')})" for name, number in names.items()]
            yield f"{what}: {', '.join(tallies)}"
    texts = dict.fromkeys(str(detail[name]) for name in ("first_text", "last_text") if name in detail)
    if texts:
        yield f"from first to last: {' … '.join(texts)}"


def _own_lines(record: AuditRecord, host_in_words: Callable[[str], str]) -> Iterator[str]:
    detail = record.detail
    yield record.reason or record.event
    sent = [f"{name} {detail[name]}" for name in ("number", "seq") if name in detail]
    author = detail.get("who")
    by = author and actor(str(author))
    who = [
        str(part)
        for part in (record.caller_id, by, record.host and f"on {host_in_words(record.host)}")
        if part
    ]
    if who or sent:
        message = f"message {', '.join(sent)} of " if sent else ""
        when = f", {rfc3339(record.time)}" if author else ""
        yield f"by: {message}{' '.join(who) or 'unknown'}{when}"
    yield from _of_stop(detail)
    if record.rule is not None:
        yield f"rule: {rule_text(record.rule)}"
    places = _list(detail.get("at"))
    if places:
        yield f"at: {', '.join(map(str, places))}"
    if "timer" in detail:
        yield f"timer: {detail['timer']}"
    events = _list(detail.get("events"))
    if events:
        yield f"events: {', '.join(map(str, events))}"
    for place, values in _mapping(detail.get("conditions")).items():
        yield f"where: {place}{_valued(values)}"
    if values := _valued(detail.get("values")):
        yield f"with: {values.removeprefix(', ')}"
    if "handler" in detail:
        yield f"in the handler of: {detail['handler']}"
    yield from _recorded(record)
    if "withheld" in detail:
        yield "this role may not read contents of messages"
        return
    if "why" in detail:
        yield from lines_of_why(_mapping(detail["why"]))
    is_verdict = record.event == "monitor verdict" or detail.get("would") == "verdict" or "handler" in detail
    if is_verdict and "why" not in detail and "count" not in detail:
        yield "because: the causing events are no longer known, or that second had too many verdicts to record them"


def _of_stop(detail: Mapping[str, Any]) -> Iterator[str]:
    if "cause" in detail:
        yield f"cause: {detail['cause']}"
    for publisher in map(_mapping, _list(detail.get("publishers"))):
        words = "last published by" if publisher.get("ended") else "published by"
        yield f"{words}: {publisher.get('node')} on {publisher.get('host')}"


def _recorded(record: AuditRecord) -> Iterator[str]:
    detail = record.detail
    if "not_recorded" in detail:
        yield f"not recorded: {detail['not_recorded']}"
    elif "recording" in detail and "charged_to" in detail and not record.event.startswith("recording "):
        recording = detail["recording"]
        yield f"recorded: in {recording}; rosrv record messages {recording} --at {record.id}"
    elif record.event in MONITOR_ACTIONS:
        yield "not recorded: recorder.triggers did not list this kind of event"


def _valued(values: object) -> str:
    return "".join(f", {name} = {value}" for name, value in _mapping(values).items())


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


_GRANTED = (
    "the policy in force has every right that it needs: it was denied for its recorded reason, or before this"
    " revision"
)


def grant_of(
    record: AuditRecord, current: PolicyKnown, *, whole_tool: bool = False, until: str = ""
) -> Granted:
    """Return the change that would allow a denied request, or raise `UngrantableError`.

    `until` is the end of the right, as for `grant`. With `whole_tool`, the change also grants all other rights that the
    stock tool of the record needs.
    """
    known, asked = PolicyContext.of(msgspec.structs.asdict(current)), asked_of(record)
    tool = stock_tool(asked.request.caller_id)
    if whole_tool:
        if tool is None:
            raise UngrantableError(
                f"{asked.request.caller_id or 'the caller'} is not a stock tool of ROS: leave out --tool"
            )
        asked = asked.with_tool(tool)
    found = grant(current.text, current.file, known, asked, until)
    needs = () if tool is None else grant(found.text, current.file, known, asked.with_tool(tool), until).added
    return Granted(
        revision=current.revision,
        reason=record.reason,
        added=list(found.added),
        diff=found.diff(current.text, current.file),
        text=found.text,
        findings=found.findings("policy", known) if found.added else [],
        tool=tool.name if tool is not None else "",
        tool_needs=list(needs),
    )


def explained(
    record: AuditRecord,
    current: PolicyKnown | None,
    in_full: LogEntry | None = None,
    host_in_words: HostInWords = str,
) -> Why:
    """Explain a record. `in_full` is the record that a record of repetitions continues."""
    found, refusal = None, ""
    try:
        if current is not None:
            found = grant_of(record, current)
            refusal = "" if found.added else _GRANTED
        elif is_denial(record):
            asked_of(record)
    except UngrantableError as error:
        refusal = str(error)
    added = [f"would be allowed by: {line}" for line in found.added] if found is not None else []
    return Why(lines=[*lines_of(record, in_full, host_in_words), *added], grant=found, refusal=refusal)


def judge_text(text: str | None, current: PolicyKnown, *, cases: bool) -> PolicyJudgement:
    """Judge a text. With `cases`, also run the test cases beside the policy file.

    Raise `ProblemError` with every finding if the text or the cases are invalid.
    """
    text, file = (current.text, current.file) if text is None else (text, "policy")
    known = PolicyContext.of(msgspec.structs.asdict(current))
    try:
        known = (
            replace(known, site_keys=())
            if cases
            else replace(known, cases=None, cases_error=None, site_keys=())
        )
        return judge(text, file, known)
    except PolicyError as error:
        raise refused_text(error) from error


def explanation(
    text: str | None, current: PolicyKnown, *, host: str, node: str, category: Category, resource: str
) -> DecisionExplanation:
    fields = msgspec.structs.asdict(current)
    known = PolicyContext.of(fields)
    policy = known.complete(judge_text(text, current, cases=False).policy)
    try:
        request = Request(find_host(host, policy), node, category, check_resource(category, resource))
    except BadWordError as error:
        raise ProblemError(422, "bad-input", str(error)) from error
    if needs_node(request) and not node:
        raise ProblemError(422, "bad-input", "the name of the node is missing: add `node`")
    return explain(policy, request)
