"""What a policy would do to the running appliance: `rosrv policy check --state` (or `--api`). Nothing is changed.

Over the socket it is judged here, with the hosts, the robot and the test cases that a reload would judge it with; over
REST it is a dry run.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from appliance.channel.admin import AdminAnswer, PolicyWanted
from appliance.cli.policy.policy_input import known_of, live_now, read_text
from appliance.cli.target import Appliance
from appliance.policy.judgement import Known, judge
from appliance.policy.live_rights import Ending, endings
from appliance.policy.policy_findings import Finding, PolicyError, Severity
from appliance.signing.site_keys import read_signature


@dataclass(frozen=True)
class Trial:
    """What is wrong or doubtful with a policy, and what is live and would end."""

    findings: list[Finding]
    ends: list[Ending]


def try_policy(
    appliance: Appliance, file: Path, robot: list[str] | None, enrolled: list[str] | None
) -> Trial:
    """Try a file; `robot` and `enrolled` go before what the appliance knows. Raises `NotRunningError`."""
    if appliance.place is not None:
        return _by_dry_run(appliance, file)
    known = known_of(robot, enrolled, Known.of(asdict(appliance.ask(PolicyWanted()).given())))
    try:
        policy = judge(read_text(file), str(file), known, read_signature(file)).accepted()
    except PolicyError as error:
        return Trial(error.findings, [])
    return Trial(list(policy.warnings), endings(policy, live_now(appliance)))


def _by_dry_run(appliance: Appliance, file: Path) -> Trial:
    from appliance.cli.rest.session import ProblemError  # noqa: PLC0415  httpx is not imported for the socket

    query, text = {"dry_run": "1"}, {"text": read_text(file), "signature": read_signature(file)}
    try:
        report = appliance.rest.call("POST", "/v1/policy", params=query, body=text, order=False)
    except ProblemError as problem:
        if problem.findings is None:
            replace(appliance, as_json=False).body_or_exit(AdminAnswer(False, error=problem.lines[0]))
            raise
        return Trial([_finding(finding, file) for finding in problem.findings], [])
    warnings = [_finding(row, file) for row in report["warnings"]]
    return Trial(warnings, [Ending(**row) for row in report["ends"]])


def _finding(given: dict[str, Any], file: Path) -> Finding:
    """A finding of REST, which calls the text `policy`."""
    named = str(file) if given["file"] == "policy" else given["file"]
    return Finding(named, given["line"], given["column"], Severity(given["severity"]), given["text"])
