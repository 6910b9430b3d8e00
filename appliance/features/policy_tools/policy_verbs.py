"""The commands `rosrv policy check|explain|test`.

Exit status: 0 allowed, valid; 1 denied, errors, a failed case; 2 usage.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.owner_access import is_named_there
from appliance.base.timestamps import local_minute
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import Json, by_host, say_json, say_row
from appliance.features.policy_tools.decision_reasons import DecisionExplanation, explain, render
from appliance.features.policy_tools.grant import DecidedRequest, UngrantableError
from appliance.features.policy_tools.grant import grant as grant_of
from appliance.features.policy_tools.policy_impact import PolicyImpact, cases_beside, impact_of
from appliance.features.policy_tools.policy_input import (
    Enrolled,
    Robot,
    asking_host,
    known_of,
    policy_in_force,
    read_text,
    usage_error,
)
from appliance.policy.actions import BadWordError, check_resource, find_host
from appliance.policy.authority import AuthorityGroup, Claim
from appliance.policy.host_sets import Atom
from appliance.policy.hours import changes_of
from appliance.policy.judgement import PolicyContext, PolicyJudgement, judge
from appliance.policy.live_rights import Ending
from appliance.policy.model import Address, Category, Decision, Request, Rule
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import FindingSeverity, PolicyError, PolicyFinding
from appliance.policy.rights import needs_node, rights_of
from appliance.policy.sections import DECIDERS
from rosmop.tool.terminal import printable, refusal, say

# List the rights of one host: the rules that grant it something. No I/O.

_CLAIMS = {
    Claim.TAKE: "may take it while it is free",
    Claim.OVERRIDE: "may also take it from its holder",
    Claim.ASK: "may only ask for it: an operator assigns it",
}
APPROVAL = "needs an approval each time (rosrv approve)"


class HostRight(NamedTuple):
    """A rule that grants a host something, or a missing section, which grants all hosts everything."""

    section: str
    rule: Rule | None
    asks: bool
    """Whether each request needs an approval."""
    text: str
    time: str = ""
    """When the host has the right, or why not now, or empty if it always has it."""
    closed: bool = False


class GroupPart(NamedTuple):
    """The part of a host in a command group of `[Authority]`: its ranks (1 is the highest), its claim, or nothing."""

    group: str
    names: list[str]
    ranks: list[tuple[int, str]]
    """Each rank with its member as written: the host, or one of its nodes."""
    of: int
    """The number of ranks of the group; 0 for a group with holders."""
    claim: Claim | None

    @property
    def text(self) -> str:
        about = f"[Authority] {self.group} ({' '.join(self.names)})"
        if self.ranks:
            places = ", ".join(f"rank {number} of {self.of} as {member}" for number, member in self.ranks)
            return f"{about}: {places}; it drives while it moves and no higher rank does"
        if self.claim is None:
            return f"{about}: no part in it, so its messages and calls of these names are denied"
        return f"{about}: {_CLAIMS[self.claim]}"


def parts_of_host(policy: Policy, host: Address) -> Iterator[GroupPart]:
    """Yield the part of the host in each command group, in the order of the policy."""
    atoms = policy.atoms_of(host)
    for group in policy.authority.values():
        yield _part(group, atoms)


def _part(group: AuthorityGroup, atoms: frozenset[Atom]) -> GroupPart:
    ranks = [
        (number, member.text)
        for number, members in enumerate(group.ranks, 1)
        for member in members
        if not member.hosts.isdisjoint(atoms)
    ]
    claim = None if group.ranks else group.claim(atoms)
    return GroupPart(group.name, sorted(group.names), ranks, len(group.ranks), claim)


def rights_of_host(policy: Policy, host: Address) -> Iterator[HostRight]:
    """Yield the rules in the order of the sections. Only the most specific key of a name decides on it."""
    standing = policy.standing(host)
    for decider in DECIDERS:
        if decider.extension and decider.categories[0] not in policy.present:
            text = f"[{decider.name}]: everything, because there is no such section"
            yield HostRight(decider.name, None, asks=False, text=text)
        for rule in (rule for category in decider.categories for rule in policy.rules(category)):
            closed = not rule.grants(standing.atoms) and not rule.asks(standing.atoms)
            if closed and rule.hosts.isdisjoint(standing.ever):
                continue
            time = (policy.closed_to if closed else policy.open_to)(host, rule.hosts)
            asks = not rule.grants(standing.ever if closed else standing.atoms)
            text = ": ".join([rule.place, *[time] * bool(time), *[APPROVAL] * asks])
            yield HostRight(decider.name, rule.rule, asks, text, time, closed)


_File = Annotated[Path, typer.Argument(readable=False, metavar="FILE", help="The policy", show_default=False)]
OptionalFile = Annotated[
    Path | None,
    typer.Argument(
        readable=False, metavar="FILE", help="The policy (default: the one in force)", show_default=False
    ),
]


@speaks
def check(appliance: Appliance, file: _File, *, robot: Robot = None, enrolled: Enrolled = None) -> None:
    """List all errors and warnings with line and column. Exit status 1 if there is an error.

    The test cases beside the file (FILE.tests.yaml) run too, as at a reload; a failed case is an error. With --state or
    --api, use the running appliance's enrolled hosts, and list the live connections that would end.

    Example: rosrv policy check policies/landshark.ini --state /var/lib/rosrv
    """
    impact = _impact(appliance, file, robot, enrolled)
    findings = impact.findings
    errors = sum(finding.severity is FindingSeverity.ERROR for finding in findings)
    for finding in findings:
        _say_finding(finding, as_json=appliance.as_json)
    if not appliance.as_json:
        warnings = len(findings) - errors
        verdict = f"{counted(errors, 'error')}: the file is invalid" if errors else f"{file} is valid"
        say(
            f"{verdict}, {counted(warnings, 'warning')}" if warnings else verdict,
            "red" if errors else "green",
        )
    if not errors:
        _say_times(known_of(robot, enrolled).compile(read_text(file), str(file)), as_json=appliance.as_json)
    _say_endings(impact.ends, appliance)
    raise typer.Exit(1 if errors else 0)


def _say_times(policy: Policy, *, as_json: bool) -> None:
    """Print when each right with a time ends, or begins next."""
    now = clock.wall()
    for atom, time in policy.times.items():
        closed = policy.closed.get(atom)
        next_change = min((change for change in changes_of({atom: time}, now) if change > now), default=None)
        begins = closed is not None and next_change is not None and next_change != time.until
        ends = closed is None and next_change is not None
        if as_json:
            moments = {"begins": next_change if begins else None, "ends": next_change if ends else None}
            say_json({"right": time.text, "line": time.line, **moments})
        else:
            verb = "ends" if ends else "begins" if begins else "has ended"
            moment = f" {local_minute(next_change)}" if next_change is not None and (ends or begins) else ""
            say(printable(f"line {time.line}: {time.text}: {verb}{moment}"), "dim" if closed else "")


def _say_endings(endings: list[Ending], appliance: Appliance) -> None:
    if appliance.as_json:
        for ending in endings:
            fields = asdict(ending)
            say_json({"ends": fields.pop("what"), **fields})
        return
    for host, its in by_host(endings, lambda ending: ending.host):
        say(f"would end on {appliance.host_in_words(host)}: {counted(len(its), 'connection')}", "yellow")
        for ending in its:
            say(
                f"  {ending.what} {ending.resource} of {ending.caller_id or 'a client'}: {ending.reason}",
                "yellow",
            )
    if endings:
        say(f"{counted(len(endings), 'live connection')} would end", "yellow")


def _say_finding(finding: PolicyFinding, *, as_json: bool) -> None:
    if as_json:
        say_json(asdict(finding))
    else:
        say(str(finding), "red" if finding.severity == "error" else "yellow")


def decision_fields(decision: Decision) -> dict[str, object]:
    place = asdict(decision.rule) if decision.rule else None
    return {"decision": decision.verdict, "rule": place, "reason": decision.reason}


def _impact(
    appliance: Appliance, file: Path, robot: list[str] | None, enrolled: list[str] | None
) -> PolicyImpact:
    if appliance.said:
        try:
            return impact_of(appliance, file, robot, enrolled)
        except NotRunningError as error:
            typer.echo(f"rosrv policy: {error}; checked without it", err=True)
    try:
        return PolicyImpact(list(_judge(file, robot, enrolled, cases_beside(file)).accept().warnings), [])
    except PolicyError as error:
        return PolicyImpact(error.findings, [])


def _allowing(policy: Policy, request: Request) -> Iterator[str]:
    known = PolicyContext(policy.enrolled, policy.robot, blocks=policy.blocks, now=clock.wall())
    try:
        found = grant_of(policy.text, policy.file, known, DecidedRequest(request, rights_of(request)))
    except UngrantableError as error:
        yield str(error)
        return
    yield from (f"would be allowed by: {line}" for line in found.added)


def compile_or_exit(
    appliance: Appliance, file: Path | None, robot: list[str] | None, enrolled: list[str] | None
) -> Policy:
    if file is not None:
        return _judge_or_exit(file, robot, enrolled).policy
    return compiled_with(*policy_in_force(appliance, robot, enrolled))


def compiled_with(text: str, name: str, known: PolicyContext) -> Policy:
    try:
        policy = known.compile(text, name)
    except PolicyError as error:  # the appliance has another version
        raise refusal(error.findings) from error
    return known.complete(policy)


@speaks
def explain_request(
    appliance: Appliance,
    file: OptionalFile = None,
    *,
    host: Annotated[
        str,
        typer.Option(
            help="The requesting host: an address, or its name: robot, a group of one host, host:NAME"
        ),
    ],
    node: Annotated[
        str, typer.Option(help="The requesting node's name (caller_id), if the request needs one")
    ] = "",
    publish: Annotated[str | None, typer.Option(metavar="TOPIC", help="Action: publish a topic")] = None,
    subscribe: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Action: subscribe to a topic")
    ] = None,
    command: Annotated[
        str | None, typer.Option(metavar="CALL", help="Action: make a call of [Commands], such as getParam")
    ] = None,
    offer: Annotated[str | None, typer.Option(metavar="SERVICE", help="Action: offer a service")] = None,
    call: Annotated[str | None, typer.Option(metavar="SERVICE", help="Action: call a service")] = None,
    read: Annotated[str | None, typer.Option(metavar="PARAMETER", help="Action: read a parameter")] = None,
    write: Annotated[str | None, typer.Option(metavar="PARAMETER", help="Action: write a parameter")] = None,
    use_node: Annotated[str | None, typer.Option(metavar="NODE", help="Action: use a node name")] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
) -> None:
    """Explain whether a request is allowed, by which rule, and which rules it overrides. Exit status 1 unless
    allowed.

    Without an action, list the rules that grant the host something; exit status 1 if none does.

    Example: rosrv policy explain --host 10.0.0.9 --node /joy --publish /cmd_vel
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
    if len(chosen) > 1 or (node and not chosen):
        raise usage_error("give exactly one action of the host: --publish TOPIC, --command CALL, …")
    policy = compile_or_exit(appliance, file, robot, enrolled)
    if not chosen:
        raise typer.Exit(_list_rights(appliance, policy, host, "in force" if file is None else str(file)))
    category, name = chosen[0]
    try:
        request = Request(asking_host(host, policy), node, category, check_resource(category, name))
    except BadWordError as error:
        raise usage_error(str(error)) from error
    if needs_node(request) and not node:
        raise usage_error("this request needs a node: give its name with --node /NAME")
    explanation = explain(policy, request)
    if appliance.as_json:
        say_json(_explanation_fields(explanation))
    else:
        for line in render(explanation):
            but = line is explanation.carried and line.startswith("but ")
            say(line, "yellow" if but else "green" if explanation.allowed else "red")
        if explanation.together == "deny" and not explanation.blocked:
            for line in _allowing(policy, request):
                say(line)
    raise typer.Exit(0 if explanation.allowed else 1)


@speaks
def show_host(
    appliance: Appliance,
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="An address, or the name of an enrolled host, a door, a group of one host, or robot",
            show_default=False,
        ),
    ],
) -> None:
    """Show what a host may do: the rules of the policy in force that grant it something, and its part in each command
    group of [Authority]. Exit status 1 if no rule grants it anything.

    Example: rosrv host show door:alice
    """
    policy = compile_or_exit(appliance, None, None, None)
    host = _known_as(name, policy)
    status = _list_rights(appliance, policy, host, "in force")
    address = asking_host(host, policy)
    for part in parts_of_host(policy, address):
        if appliance.as_json:
            say_json({"host": str(address), **part._asdict()})
        else:
            say_row([part.text], "" if part.ranks or part.claim else "dim")
    raise typer.Exit(status)


def _known_as(name: str, policy: Policy) -> str:
    """Return the word of the policy for a host: an enrolled host or a door may be named without its kind."""
    for word in (name, f"host:{name}", f"door:{name}"):
        with contextlib.suppress(BadWordError):
            find_host(word, policy)
            return word
    return name


def _list_rights(appliance: Appliance, policy: Policy, host: str, which: str) -> int:
    try:
        address = asking_host(host, policy)
    except BadWordError as error:
        raise usage_error(str(error)) from error
    if not appliance.as_json:
        say(f"{host}, by the policy {which}:", "bold")
    rights = list(rights_of_host(policy, address))
    for right in rights:
        if appliance.as_json:
            place = asdict(right.rule) if right.rule is not None else None
            verdict = "deny" if right.closed else "ask" if right.asks else "allow"
            fields = {"section": right.section, "rule": place, "decision": verdict}
            say_json({"host": str(address), **fields, **({"time": right.time} if right.time else {})})
        else:
            say(right.text, "dim" if right.closed else "yellow" if right.asks else "")
    held = any(not right.closed for right in rights)
    if not appliance.as_json:
        if not held:
            say(f"no rule grants {address} anything{' now' if rights else ''}", "red")
        if address in policy.blocks:
            say(f"whatever the rules say: {address} is {policy.blocks[address]}", "yellow")
    return 0 if held else 1


def _explanation_fields(explanation: DecisionExplanation) -> dict[str, object]:
    fields: dict[str, object] = {
        **explanation.request.fields(),
        **decision_fields(explanation.decision),
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
    if explanation.carried:
        fields["carried"] = explanation.carried
    for word, also in (("node", explanation.node), ("command", explanation.command)):
        if also is not None:
            fields[word] = _explanation_fields(also)
    if explanation.also:
        fields["together"] = explanation.together
    return fields


def test(
    file: _File,
    cases: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File of test cases (default: FILE.tests.yaml)")
    ] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
    as_json: Json = False,
) -> None:
    """Run the test cases of a policy. Exit status 1 if one fails.

    Example: rosrv policy test policies/landshark.ini
    """
    beside = cases or cases_beside(file)
    results = _judge_or_exit(file, robot, enrolled, beside).results
    if not results and not is_named_there(beside):
        raise usage_error(
            f"there is no file {beside}: write test cases into it, or name another with --cases"
        )
    if not results:  # a file of cases has at least one
        read_text(beside)
    failed = [result for result in results if not result.passed]
    for result in results if as_json else failed:
        if as_json:
            place = {"file": result.file, "line": result.line, "column": result.column}
            expected = {"passed": result.passed, "expected": result.expected}
            say_json({**place, **expected, **result.request.fields(), **decision_fields(result.decision)})
        else:
            say(str(result), "red")
    if not as_json:
        say(f"{len(results) - len(failed)} passed, {len(failed)} failed", "red" if failed else "green")
    raise typer.Exit(1 if failed else 0)


def _judge(
    file: Path, robot: list[str] | None, enrolled: list[str] | None, cases: Path | None = None
) -> PolicyJudgement:
    known, text = known_of(robot, enrolled), read_text(file)
    if cases is not None and is_named_there(cases):
        known = replace(known, cases_file=str(cases), cases=read_text(cases))
    return judge(text, str(file), known)


def _judge_or_exit(
    file: Path, robot: list[str] | None, enrolled: list[str] | None, cases: Path | None = None
) -> PolicyJudgement:
    try:
        return _judge(file, robot, enrolled, cases)
    except PolicyError as error:
        raise refusal(error.findings) from error
