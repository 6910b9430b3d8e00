"""How the policy verbs show findings, requests and decisions."""

from appliance.cli.output import say, say_json
from appliance.policy import Decision, Finding, Request


def say_finding(finding: Finding, *, as_json: bool) -> None:
    """Write an error or a warning."""
    if as_json:
        say_json(
            {
                "file": finding.file,
                "line": finding.line,
                "column": finding.column,
                "severity": finding.severity,
                "text": finding.text,
            }
        )
    else:
        say(str(finding), "red" if finding.severity == "error" else "yellow")


def request_fields(request: Request) -> dict[str, object]:
    """A request as the audit log writes it."""
    return {
        "host": str(request.host),
        "caller_id": request.caller_id,
        "category": request.category,
        "resource": request.resource,
    }


def decision_fields(decision: Decision) -> dict[str, object]:
    """A decision as the audit log writes it."""
    rule = decision.rule
    place = {"section": rule.section, "key": rule.key, "file": rule.file, "line": rule.line} if rule else None
    return {"decision": decision.word, "rule": place, "reason": decision.reason}
