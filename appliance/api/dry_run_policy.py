"""What a policy would do, found out here without asking RVMaster: errors, tests, what is live, explanations.

Everything is a pure function of texts; it runs in a thread, and a stranger's long text costs RVMaster nothing.
`current` is control's answer to `PolicyWanted`, and a text of None the policy in force.
"""

from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import msgspec

from appliance.api.denials import asked_of, is_denial
from appliance.api.policy_models import Change, Ended, Report
from appliance.api.problems import Finding, ProblemError
from appliance.audit.record import Record
from appliance.audit.why import lines_of
from appliance.channel.admin import PolicyLoad
from appliance.channel.answers.graph_answers import Registration
from appliance.channel.answers.policy_answers import Granted, PolicyKnown, Why
from appliance.policy.actions import BadWordError, check_resource, find_hosts
from appliance.policy.decision_reasons import Explanation, explain
from appliance.policy.diff import diff
from appliance.policy.grant import UngrantableError, grant
from appliance.policy.judgement import Judged, Known, judge
from appliance.policy.live_rights import Live, endings
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import needs_node

_GRANTED = (
    "the policy in force has every right that it needs: it was refused for what its reason says, or before this"
    " revision"
)


def judge_change(order: PolicyLoad, current: PolicyKnown, registrations: Iterable[Registration]) -> Report:
    """What a new text would do that is loaded in the place of the policy in force.

    Raises `ProblemError` with every finding when it is refused.
    """
    known = Known.of(msgspec.structs.asdict(current))
    before = compile_policy(current.text, file=current.file, hosts=known.hosts, robot=known.robot)
    try:
        policy = judge(order.text, "policy", known, order.signature).accepted()
    except PolicyError as error:
        raise _refused(error) from error
    live = [Live.of(msgspec.structs.asdict(row)) for row in registrations]
    changes = diff(before, policy, (request for thing in live for request in thing.requests()))
    return Report(
        loaded=False,
        revision=current.revision,
        warnings=_findings_of(policy.warnings),
        changes=[
            Change(
                **change.request.fields(), now=change.old.word, then=change.new.word, reason=change.new.reason
            )
            for change in changes
        ],
        ends=[Ended(**asdict(end)) for end in endings(policy, live)],
    )


def granted(record: Record, current: PolicyKnown) -> Granted:
    """What would grant what a record says was refused. Raises `UngrantableError` where no line of a policy does."""
    known = Known.of(msgspec.structs.asdict(current))
    found = grant(current.text, current.file, known, asked_of(record))
    return Granted(
        revision=current.revision,
        reason=record.reason,
        added=list(found.added),
        diff=found.diff(current.text, current.file),
        text=found.text,
        findings=found.findings("policy", known) if found.added else [],
    )


def explained(record: Record, current: PolicyKnown | None) -> Why:
    """Why what a record tells happened; of a denial that a policy might allow, the one in force is needed."""
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
    return Why(lines=[*lines_of(record), *added], grant=found, refusal=refusal)


def judge_text(text: str | None, current: PolicyKnown, *, cases: bool) -> Judged:
    """A text, signed or not, with the cases beside the policy file if they matter, whether it passes them or not.

    Raises `ProblemError` with every finding when the text or the cases cannot be understood.
    """
    text, file = (current.text, current.file) if text is None else (text, "policy")
    known = Known.of(msgspec.structs.asdict(current))
    try:
        known = replace(known, site_keys=()) if cases else Known(known.hosts, known.robot)
        return judge(text, file, known)
    except PolicyError as error:
        raise _refused(error) from error


def explanation(
    text: str | None, current: PolicyKnown, *, host: str, node: str, category: Category, resource: str
) -> Explanation:
    """Why a request is decided as it is. Raises `ProblemError` when the request makes no sense."""
    policy = judge_text(text, current, cases=False).policy
    try:
        request = Request(find_hosts(host, policy)[0], node, category, check_resource(category, resource))
    except BadWordError as error:
        raise ProblemError(422, "bad-input", str(error)) from error
    if needs_node(request) and not node:
        raise ProblemError(422, "bad-input", "this makes a node part of the graph: say its name (node)")
    return explain(policy, request)


def _findings_of(findings: Iterable[Any]) -> list[Finding]:
    return [Finding(**asdict(finding)) for finding in findings]


def _refused(error: PolicyError) -> ProblemError:
    findings = sorted(error.findings, key=lambda finding: finding.severity != "error")
    errors = sum(finding.severity == "error" for finding in findings)
    more = f", and {errors - 1} more" if errors > 1 else ""
    first = findings[0]
    return ProblemError(
        422,
        "policy-refused",
        f"the policy is refused, nothing was changed: {first.file}:{first.line}:{first.column}: {first.text}{more}",
        findings=_findings_of(findings),
    )
