"""Explain decisions, records and denials, and judge texts, without RVMaster.

Every function is pure and runs in a thread, so a client's long text costs RVMaster nothing. If `text` is None,
the policy in force, `current`, is used.
"""

from dataclasses import replace

import msgspec

from appliance.api.front.problems import ProblemError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.channel.answers.policy_answers import Granted, PolicyKnown, Why
from appliance.features.policy_tools.decision_reasons import DecisionExplanation, explain
from appliance.features.policy_tools.denials import asked_of, is_denial
from appliance.features.policy_tools.dry_run_policy import refused_text
from appliance.features.policy_tools.grant import UngrantableError, grant
from appliance.features.policy_tools.stock_tools import stock_tool
from appliance.features.policy_tools.why import lines_of
from appliance.policy.actions import BadWordError, check_resource, find_host
from appliance.policy.host_names import HostInWords
from appliance.policy.judgement import PolicyContext, PolicyJudgement, judge
from appliance.policy.model import Category, Request
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import needs_node

_GRANTED = (
    "the policy in force has every right that it needs: it was denied for its recorded reason, or before this"
    " revision"
)


def granted(record: AuditRecord, current: PolicyKnown, *, whole_tool: bool = False) -> Granted:
    """Return the change that would allow a denied request, or raise `UngrantableError`.

    With `whole_tool`, the change also grants all other rights that the stock tool of the record needs.
    """
    known, asked = PolicyContext.of(msgspec.structs.asdict(current)), asked_of(record)
    tool = stock_tool(asked.request.caller_id)
    if whole_tool:
        if tool is None:
            raise UngrantableError(
                f"{asked.request.caller_id or 'the caller'} is not a stock tool of ROS: leave out --tool"
            )
        asked = asked.with_tool(tool)
    found = grant(current.text, current.file, known, asked)
    needs = [] if tool is None else grant(found.text, current.file, known, asked.with_tool(tool)).added
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
            found = granted(record, current)
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
            replace(known, site_keys=()) if cases else PolicyContext(known.hosts, known.robot, own=known.own)
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
