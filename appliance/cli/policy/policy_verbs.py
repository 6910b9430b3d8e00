"""`rosrv policy check|explain|test|diff|learn`: judge a policy before it is in force; no appliance needs to run.

Exit status: 0 allowed, right, no difference; 1 denied, errors, a failed case, a difference; 2 usage.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.admin_client import NotRunningError
from appliance.cli.output import Json, say_json
from appliance.cli.policy.policy_input import (
    Enrolled,
    Robot,
    find_host,
    known_of,
    live_now,
    read_text,
    requests_of_audit_log,
    requests_of_file,
    usage_error,
)
from appliance.cli.policy.trial import Trial, try_policy
from appliance.cli.target import Appliance, speaks
from appliance.policy.actions import BadWordError, check_resource
from appliance.policy.decision_reasons import Explanation, explain, render
from appliance.policy.diff import Difference, diff
from appliance.policy.grant import Asked, UngrantableError
from appliance.policy.grant import grant as grant_of
from appliance.policy.judgement import Judged, judge
from appliance.policy.model import Category, Decision, Request
from appliance.policy.policy_findings import Finding, PolicyError, Severity
from appliance.policy.rights import needs_node, rights_of
from rosmop.tool.terminal import counted, refused, say

_File = Annotated[Path, typer.Argument(metavar="FILE", help="The policy", show_default=False)]


@speaks
def check(appliance: Appliance, file: _File, *, robot: Robot = None, enrolled: Enrolled = None) -> None:
    """Report every error and warning with its place; exit status 1 if there is an error.

    With --state or --api the running appliance says who is enrolled, and what is live and the policy would end.

    Example: rosrv policy check policies/landshark.ini --state /var/lib/rosrv
    """
    trial = _tried(appliance, file, robot, enrolled)
    findings = trial.findings
    errors = sum(finding.severity is Severity.ERROR for finding in findings)
    for finding in findings:
        _say_finding(finding, as_json=appliance.as_json)
    if not appliance.as_json:
        warnings = len(findings) - errors
        verdict = f"{counted(errors, 'error')}: the file is refused" if errors else f"{file} is right"
        say(
            f"{verdict}, {counted(warnings, 'warning')}" if warnings else verdict,
            "red" if errors else "green",
        )
    for ending in trial.ends:
        if appliance.as_json:
            fields = asdict(ending)
            say_json({"ends": fields.pop("what"), **fields})
        else:
            whose = f"{ending.caller_id or 'a client'} on {ending.host}"
            say(f"would end: {ending.what} {ending.resource} of {whose}: {ending.reason}", "yellow")
    if trial.ends and not appliance.as_json:
        say(f"{counted(len(trial.ends), 'live connection')} would end", "yellow")
    raise typer.Exit(1 if errors else 0)


def _say_finding(finding: Finding, *, as_json: bool) -> None:
    """Write an error or a warning."""
    if as_json:
        say_json(asdict(finding))
    else:
        say(str(finding), "red" if finding.severity == "error" else "yellow")


def _decision_fields(decision: Decision) -> dict[str, object]:
    """A decision as the audit log writes it."""
    place = asdict(decision.rule) if decision.rule else None
    return {"decision": decision.word, "rule": place, "reason": decision.reason}


def _tried(appliance: Appliance, file: Path, robot: list[str] | None, enrolled: list[str] | None) -> Trial:
    if appliance.said:
        try:
            return try_policy(appliance, file, robot, enrolled)
        except NotRunningError as error:
            typer.echo(f"rosrv policy: {error}; checked without it", err=True)
    try:
        return Trial(list(_judge(file, robot, enrolled).policy.warnings), [])
    except PolicyError as error:
        return Trial(error.findings, [])


def _allowing(
    file: Path, request: Request, robot: list[str] | None, enrolled: list[str] | None
) -> Iterator[str]:
    """The smallest change of the policy that would allow it."""
    try:
        found = grant_of(
            read_text(file), str(file), known_of(robot, enrolled), Asked(request, rights_of(request))
        )
    except UngrantableError as error:
        yield str(error)
        return
    yield from (f"would be allowed by: {line}" for line in found.added)


def explain_request(
    file: _File,
    *,
    host: Annotated[str, typer.Option(help="Who asks: an address, robot, or host:NAME")],
    node: Annotated[str, typer.Option(help="Its node name (caller_id), where a node is needed")] = "",
    publish: Annotated[str | None, typer.Option(metavar="TOPIC", help="publish a topic")] = None,
    subscribe: Annotated[str | None, typer.Option(metavar="TOPIC", help="subscribe to a topic")] = None,
    command: Annotated[str | None, typer.Option(metavar="CALL", help="make a call")] = None,
    offer: Annotated[str | None, typer.Option(metavar="SERVICE", help="offer a service")] = None,
    call: Annotated[str | None, typer.Option(metavar="SERVICE", help="call a service")] = None,
    read: Annotated[str | None, typer.Option(metavar="PARAMETER", help="read a parameter")] = None,
    write: Annotated[str | None, typer.Option(metavar="PARAMETER", help="write a parameter")] = None,
    use_node: Annotated[str | None, typer.Option(metavar="NODE", help="use a node name")] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
    as_json: Json = False,
) -> None:
    """Say whether a request is allowed, by which rule, and which rules lost; exit status 1 if it is denied.

    Example: rosrv policy explain policies/landshark.ini --host 10.0.0.9 --node /joystick --publish /cmd_vel
    """
    asked = {
        Category.PUBLISH: publish,
        Category.SUBSCRIBE: subscribe,
        Category.COMMAND: command,
        Category.OFFER: offer,
        Category.CALL: call,
        Category.READ: read,
        Category.WRITE: write,
        Category.NODE: use_node,
    }
    chosen = [(category, name) for category, name in asked.items() if name is not None]
    if len(chosen) != 1:
        raise usage_error("say one thing that the host does: --publish TOPIC, --command CALL, …")
    policy = _judge_or_exit(file, robot, enrolled).policy
    category, name = chosen[0]
    try:
        request = Request(find_host(host, policy), node, category, check_resource(category, name))
    except BadWordError as error:
        raise usage_error(str(error)) from error
    if needs_node(request) and not node:
        raise usage_error("this makes a node part of the graph: say its name with --node /NAME")
    explanation = explain(policy, request)
    if as_json:
        say_json(_explanation_fields(explanation))
    else:
        for line in render(explanation):
            say(line, "green" if explanation.allowed else "red")
        if not explanation.allowed:
            for line in _allowing(file, request, robot, enrolled):
                say(line)
    raise typer.Exit(0 if explanation.allowed else 1)


def _explanation_fields(explanation: Explanation) -> dict[str, object]:
    fields: dict[str, object] = {
        **explanation.request.fields(),
        **_decision_fields(explanation.decision),
        "told": explanation.told,
        "through": list(explanation.through),
        "lost": [
            {
                "section": lost.rule.section,
                "key": lost.rule.key,
                "line": lost.rule.line,
                "would": "allow" if lost.grants else "deny",
                "why": lost.why,
            }
            for lost in explanation.lost
        ],
    }
    if explanation.limit:
        fields["limit"] = explanation.limit
    for word, also in (("node", explanation.node), ("command", explanation.command)):
        if also is not None:
            fields[word] = _explanation_fields(also)
    if explanation.also:
        fields["together"] = "allow" if explanation.allowed else "deny"
    return fields


def test(
    file: _File,
    cases: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The cases (default: FILE.tests.yaml)")
    ] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
    as_json: Json = False,
) -> None:
    """Run the cases beside a policy; exit status 1 if one of them is decided otherwise.

    Example: rosrv policy test policies/landshark.ini
    """
    beside = cases or file.with_name(file.name + ".tests.yaml")
    results = _judge_or_exit(file, robot, enrolled, beside).results
    if not results:  # a file of cases has at least one
        read_text(beside)
    failed = [result for result in results if not result.passed]
    for result in results if as_json else failed:
        if as_json:
            place = {"file": result.file, "line": result.line, "column": result.column}
            expected = {"passed": result.passed, "expected": "allow" if result.expected else "deny"}
            say_json({**place, **expected, **result.request.fields(), **_decision_fields(result.decision)})
        else:
            say(str(result), "red")
    if not as_json:
        say(f"{len(results) - len(failed)} passed, {len(failed)} failed", "red" if failed else "green")
    raise typer.Exit(1 if failed else 0)


@speaks
def compare(
    appliance: Appliance,
    old: Annotated[Path, typer.Argument(metavar="OLD", help="The policy now", show_default=False)],
    new: Annotated[Path, typer.Argument(metavar="NEW", help="The policy to be", show_default=False)],
    *,
    requests: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="NDJSON of requests: host, caller_id, category, resource"),
    ] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
) -> None:
    """Show the requests that were seen and would be decided differently; exit status 1 if there are any.

    Example: rosrv policy diff policies/now.ini policies/next.ini --state /var/lib/rosrv
    """
    if requests is None and not appliance.said:
        raise usage_error(
            "say where the requests are: --state DIR or --api URL (the audit log), or --requests FILE"
        )
    before, after = (_judge_or_exit(file, robot, enrolled).policy for file in (old, new))
    differences = diff(before, after, _requests(requests, appliance))
    for difference in differences:
        if appliance.as_json:
            say_json(_difference_fields(difference))
        else:
            for line in _difference_lines(difference):
                say(line, "yellow" if difference.granted else "red")
    if not appliance.as_json:
        say(f"{counted(len(differences), 'request')} would be decided differently")
    raise typer.Exit(1 if differences else 0)


def _requests(file: Path | None, appliance: Appliance) -> Iterator[Request]:
    if file is not None:
        yield from requests_of_file(file)
    else:
        yield from requests_of_audit_log(appliance)
        with contextlib.suppress(NotRunningError):
            for live in live_now(appliance):
                yield from live.requests()


def _difference_lines(difference: Difference) -> Iterator[str]:
    request = difference.request
    who = f"{request.host} {request.caller_id}".strip()
    yield f"{difference.word}: {who}: {request.category} {request.resource}"
    yield f"  seen in {counted(difference.count, 'record')}"
    yield f"  old: {difference.old.reason}"
    yield f"  new: {difference.new.reason}"


def _difference_fields(difference: Difference) -> dict[str, object]:
    return {
        **difference.request.fields(),
        "count": difference.count,
        "old": _decision_fields(difference.old),
        "new": _decision_fields(difference.new),
    }


def _judge(
    file: Path, robot: list[str] | None, enrolled: list[str] | None, cases: Path | None = None
) -> Judged:
    known, text = known_of(robot, enrolled), read_text(file)
    if cases is not None and cases.exists():
        known = replace(known, cases_file=str(cases), cases=read_text(cases))
    return judge(text, str(file), known)


def _judge_or_exit(
    file: Path, robot: list[str] | None, enrolled: list[str] | None, cases: Path | None = None
) -> Judged:
    try:
        return _judge(file, robot, enrolled, cases)
    except PolicyError as error:
        raise refused(error.findings) from error
