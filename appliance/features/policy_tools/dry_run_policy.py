"""Compute the effects of a policy without RVMaster: errors, tests, live connections, explanations.

Every function takes texts and runs in a thread, so a client's long text costs RVMaster nothing. `current` is
control's answer to `PolicyWanted`; if `text` is None, the policy in force is used.
"""

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import msgspec

from appliance.api.front.problems import ProblemError
from appliance.channel.admin import PolicyLoad
from appliance.channel.answers.graph_answers import Registration
from appliance.channel.answers.monitor_answers import Finding
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.features.policy_tools.diff import diff
from appliance.features.policy_tools.policy_models import Change, Ended, Report
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.live_rights import LiveRight, endings
from appliance.policy.policy_findings import PolicyError


def judge_change(order: PolicyLoad, current: PolicyKnown, registrations: Iterable[Registration]) -> Report:
    """Return the effects of a change. Raises `ProblemError` with every finding if the text is rejected."""
    known = PolicyContext.of(msgspec.structs.asdict(current))
    before = known.compile(current.text, current.file)
    try:
        policy = judge(order.text, "policy", known, order.signature).accept()
    except PolicyError as error:
        raise refused_text(error) from error
    live = [LiveRight.of(msgspec.structs.asdict(row)) for row in registrations]
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


def _findings_of(findings: Iterable[Any]) -> list[Finding]:
    return [Finding(**asdict(finding)) for finding in findings]


def refused_text(error: PolicyError) -> ProblemError:
    findings = sorted(error.findings, key=lambda finding: finding.severity != "error")
    errors = sum(finding.severity == "error" for finding in findings)
    more = f", and {errors - 1} more" if errors > 1 else ""
    first = findings[0]
    return ProblemError(
        422,
        "policy-refused",
        f"the policy is rejected, nothing was changed: {first.file}:{first.line}:{first.column}: {first.text}{more}",
        findings=_findings_of(findings),
    )
