"""What a policy would do, found out here without asking RVMaster: errors, tests, what is live, explanations.

Everything is a pure function of texts; it runs in a thread, and a stranger's long text costs RVMaster nothing.
"""

import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from appliance.api.problems import Finding, ProblemError
from appliance.policy import (
    CaseResult,
    Category,
    Difference,
    Explanation,
    Policy,
    PolicyError,
    Request,
    compile_policy,
    diff,
    explain,
    run_cases,
)
from appliance.policy.actions import BadWordError, check_resource
from appliance.policy.hosts import Network, canonical_address
from appliance.policy.model import Address, Decision
from appliance.policy.rights import needs_node


@dataclass(frozen=True, slots=True)
class Judgement:
    """A policy that can be taken: its warnings, and what is live and would be decided differently."""

    warnings: list[Finding]
    changes: list[Difference]


def judge(text: str, current: Mapping[str, Any], registrations: Iterable[Mapping[str, str]]) -> Judgement:
    """Judge a new text beside the policy in force (`current` is control's answer to `PolicyWanted`).

    Raises `ProblemError` with every finding when it would be refused.
    """
    policy = _compile(text, "policy", current)
    _test(policy, current)
    before = _compile(current["text"], current["file"], current)
    live = [
        Request(
            canonical_address(ipaddress.ip_address(one["host"])),
            one["caller_id"],
            Category(one["category"]),
            one["resource"],
        )
        for one in registrations
    ]
    return Judgement(findings_of(policy.warnings), diff(before, policy, live))


def tested(text: str | None, current: Mapping[str, Any]) -> list[CaseResult]:
    """The cases beside the policy file on a text (None: the one in force); empty when there is no such file.

    Raises `ProblemError` with every finding when the text or the cases cannot be understood.
    """
    policy = (
        _compile(current["text"], current["file"], current)
        if text is None
        else _compile(text, "policy", current)
    )
    return _cases(policy, current)


def explanation(
    text: str, file: str, current: Mapping[str, Any], *, host: str, node: str, category: str, resource: str
) -> Explanation:
    """Why a request is decided as it is. Raises `ProblemError` when the request makes no sense."""
    policy = _compile(text, file, current)
    try:
        request = Request(
            _host(host, current), node, Category(category), check_resource(Category(category), resource)
        )
    except BadWordError as error:
        raise ProblemError(422, "bad-input", str(error)) from error
    if needs_node(request) and not node:
        raise ProblemError(422, "bad-input", "this makes a node part of the graph: say its name (node)")
    return explain(policy, request)


def findings_of(findings: Iterable[Any]) -> list[Finding]:
    """The policy's findings as they are answered."""
    return [
        Finding(file=one.file, line=one.line, column=one.column, severity=one.severity.value, text=one.text)
        for one in findings
    ]


def word_of(decision: Decision) -> Literal["allow", "deny", "would deny"]:
    """A decision in the audit log's words."""
    return "would deny" if decision.would_deny else "allow" if decision.allowed else "deny"


def _host(text: str, current: Mapping[str, Any]) -> Address:
    if text == "robot":
        robots = [one for one in map(_robot, current["robot"]) if not hasattr(one, "prefixlen")]
        if not robots:
            raise ProblemError(422, "bad-input", "the robot has no address here: give one")
        text = str(robots[0])
    try:
        return canonical_address(ipaddress.ip_address(text))
    except ValueError:
        raise ProblemError(422, "bad-input", f"host: {text[:80]!r} is no address, and not `robot`") from None


def _robot(text: str) -> Address | Network:
    return ipaddress.ip_network(text) if "/" in text else ipaddress.ip_address(text)


def _compile(text: str, file: str, current: Mapping[str, Any]) -> Policy:
    try:
        hosts = {name: ipaddress.ip_address(address) for name, address in current["hosts"].items()}
        return compile_policy(text, file=file, hosts=hosts, robot=[_robot(one) for one in current["robot"]])
    except PolicyError as error:
        raise _refused(findings_of(error.findings)) from error


def _cases(policy: Policy, current: Mapping[str, Any]) -> list[CaseResult]:
    file = current["cases_file"]
    if current["cases_error"] is not None:
        raise _refused([Finding(file=file, line=1, column=1, severity="error", text=current["cases_error"])])
    if current["cases"] is None:
        return []
    try:
        return run_cases(policy, current["cases"], file)
    except PolicyError as error:
        raise _refused(findings_of(error.findings)) from error


def _test(policy: Policy, current: Mapping[str, Any]) -> None:
    failed = [one for one in _cases(policy, current) if not one.passed]
    if failed:
        raise _refused(
            [
                Finding(
                    file=one.file,
                    line=one.line,
                    column=one.column,
                    severity="error",
                    text=f"expected {'allow' if one.expected else 'deny'}: {one.decision.reason}",
                )
                for one in failed
            ]
        )


def _refused(findings: list[Finding]) -> ProblemError:
    errors = [one for one in findings if one.severity == "error"]
    rest = [one for one in findings if one.severity != "error"]
    first = errors[0]
    more = f", and {len(errors) - 1} more" if len(errors) > 1 else ""
    return ProblemError(
        422,
        "policy-refused",
        f"the policy is refused, nothing was changed: {first.file}:{first.line}:{first.column}: {first.text}{more}",
        findings=errors + rest,
    )
