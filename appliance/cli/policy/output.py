"""How the policy verbs show findings and decisions."""

from dataclasses import asdict

from appliance.cli.output import say, say_json
from appliance.policy import Decision, Finding


def say_finding(finding: Finding, *, as_json: bool) -> None:
    """Write an error or a warning."""
    if as_json:
        say_json(asdict(finding))
    else:
        say(str(finding), "red" if finding.severity == "error" else "yellow")


def decision_fields(decision: Decision) -> dict[str, object]:
    """A decision as the audit log writes it."""
    rule = decision.rule
    place = {"section": rule.section, "key": rule.key, "file": rule.file, "line": rule.line} if rule else None
    return {"decision": decision.word, "rule": place, "reason": decision.reason}
