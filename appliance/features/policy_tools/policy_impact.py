"""Compute the impact of a policy on the running appliance, for `rosrv policy check --state` (or `--api`).

Over REST, the appliance does a dry run.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer
from msgspec.structs import asdict

from appliance.base.owner_access import is_named_there
from appliance.channel.admin import PolicyWanted
from appliance.cli.connection.admin_client import RestProblemError
from appliance.cli.connection.target import Appliance
from appliance.features.policy_tools.policy_input import known_of, live_now, read_text
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.live_rights import Ending, endings
from appliance.policy.policy_findings import FindingSeverity, PolicyError, PolicyFinding
from appliance.signing.site_keys import read_signature
from rosmop.tool.terminal import printable


@dataclass(frozen=True)
class PolicyImpact:
    """The effects of a policy; `ends` are the live connections that it would end."""

    findings: list[PolicyFinding]
    ends: list[Ending]


def impact_of(
    appliance: Appliance, file: Path, robot: list[str] | None, enrolled: list[str] | None
) -> PolicyImpact:
    if appliance.place is not None:
        return _by_dry_run(appliance, file)
    known = known_of(robot, enrolled, PolicyContext.of(asdict(appliance.ask(PolicyWanted()).unwrap())))
    try:
        policy = judge(read_text(file), str(file), known, read_signature(file)).accept()
        beside = cases_beside(file)
        if is_named_there(beside) and str(beside.absolute()) != known.cases_file:
            own = replace(known, cases_file=str(beside), cases=read_text(beside), site_keys=())
            judge(policy.text, str(file), own).accept()
    except PolicyError as error:
        return PolicyImpact(error.findings, [])
    return PolicyImpact(list(policy.warnings), endings(policy, live_now(appliance)))


def cases_beside(file: Path) -> Path:
    return file.with_name(file.name + ".tests.yaml")


def _by_dry_run(appliance: Appliance, file: Path) -> PolicyImpact:
    query, text = {"dry_run": "1"}, {"text": read_text(file), "signature": read_signature(file)}
    try:
        report = appliance.rest.call("POST", "/v1/policy", params=query, body=text, order=False)
    except RestProblemError as problem:
        if problem.findings is None:
            typer.echo(f"rosrv: {printable(problem.lines[0])}", err=True)
            raise typer.Exit(1) from None
        return PolicyImpact([_finding(finding, file) for finding in problem.findings], [])
    warnings = [_finding(row, file) for row in report["warnings"]]
    return PolicyImpact(warnings, [Ending(**row) for row in report["ends"]])


def _finding(given: dict[str, Any], file: Path) -> PolicyFinding:
    named = str(file) if given["file"] == "policy" else given["file"]
    return PolicyFinding(
        named, given["line"], given["column"], FindingSeverity(given["severity"]), given["text"]
    )
