"""The command `rosrv policy learn`."""

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import typer
import yaml

from appliance.audit.search.filter_options import Since
from appliance.base.counted import counted
from appliance.base.input_files import names_of_hosts
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import OR_STANDARD, STANDARD_OUTPUT, say_json, write_new, write_told
from appliance.cli.output import usage_error as usage
from appliance.features.policy_tools.audit_only import EnforceError, enforced_text
from appliance.features.policy_tools.grant import DecidedRequest, UngrantableError, grant
from appliance.features.policy_tools.learn import (
    ROBOT,
    LearnedPolicy,
    is_covered,
    lasting_name,
    learn,
    needed_rights,
)
from appliance.features.policy_tools.policy_impact import cases_beside
from appliance.features.policy_tools.policy_input import (
    RecordedPeriod,
    Robot,
    body_in_force,
    context_of,
    networks_of,
    read_text,
    recorded_period,
    running_robot,
    usage_error,
)
from appliance.features.policy_tools.stock_tools import name_for
from appliance.policy.actions import VERBS, BadWordError
from appliance.policy.cases import MAXIMUM_CHARACTERS, run_cases
from appliance.policy.host_sets import Network
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import Right, decide_right
from appliance.policy.rules import MAXIMUM_INNER_STARS
from appliance.policy.sections import PARAMETERS
from rosmop.tool.terminal import printable, refusal, say
from roswire.names import is_global_name

# Extend a policy by questions to a person: one for each kind of right that recorded requests needed and it denies.
#
# An answer is a line of the policy, or a test case: what a person denied is a `deny` case, so the next run does not ask
# again. Both files are written after each answer.

Answer = Literal["allow", "deny", "wider", "later", "quit"]
_LETTERS: dict[str, Answer] = {"a": "allow", "d": "deny", "w": "wider", "l": "later", "q": "quit"}
_VERBS = {category: verb for verb, category in VERBS.items()}


class RightKind(NamedTuple):
    """A right of a host that recorded requests needed; an anonymous name is a pattern."""

    category: Category
    name: str
    host: Address

    @property
    def action(self) -> str:
        return f"{_VERBS[self.category]} {name_for(self.name)}"

    @property
    def wider(self) -> str:
        """The pattern for all names beside this one, or an empty text."""
        above = self.name.rpartition("/")[0]
        return f"{above}/**" if above and self.category not in {Category.COMMAND, *PARAMETERS} else ""


@dataclass
class AskedPolicy:
    """A policy's text and its test cases, which answers extend. Raises `PolicyError` for an invalid text."""

    text: str
    file: str
    known: PolicyContext
    given: dict[str, object] = field(default_factory=dict)
    cases: list[object] = field(default_factory=list)
    _denied: set[tuple[Category, str, Address]] = field(default_factory=set)
    _policy: tuple[str, Policy] | None = None

    def __post_init__(self) -> None:
        if self.cases:
            results = run_cases(self._compile(), self.cases_text, f"{self.file}.tests.yaml")
            denied = (result.request for result in results if result.expected == "deny")
            self._denied |= {(request.category, request.resource, request.host) for request in denied}
        members = [str(place.network_address) for place in self._compile().robot]
        if members:
            self.given.setdefault("robot", members)

    @property
    def cases_text(self) -> str:
        given = {"given": self.given} if self.given else {}
        return yaml.safe_dump({**given, "cases": self.cases}, sort_keys=False)

    def _compile(self) -> Policy:
        return self.known.compile(self.text, self.file)

    def missing(self, counts: Counter[tuple[RightKind, str]]) -> Iterator[tuple[RightKind, str, int]]:
        """Yield the kinds that the rules deny and no test case denies, with a node and the number of requests.

        The answer to a kind may change the text, by which the next kind is judged.
        """
        totals: Counter[RightKind] = Counter()
        nodes: dict[RightKind, str] = {}
        for (kind, node), count in counts.items():
            totals[kind] += count
            nodes[kind] = min(nodes.get(kind, node), node)
        order = list(Category)
        for kind in sorted(totals, key=lambda kind: (order.index(kind.category), kind.name, str(kind.host))):
            if self._denies(kind):
                yield kind, nodes[kind], totals[kind]

    def _denies(self, kind: RightKind) -> bool:
        name = name_for(kind.name)
        if (kind.category, name, kind.host) in self._denied:
            return False
        policy = self._enforce()
        if kind.category in PARAMETERS and kind.category not in policy.present:
            return False
        decision = decide_right(policy, Right(Request(kind.host, "", kind.category, name)))
        return not decision.allowed and decision.asks is None

    def _enforce(self) -> Policy:
        if self._policy is None or self._policy[0] != self.text:
            try:
                text = enforced_text(self.text).text
            except EnforceError:  # it is enforced already
                text = self.text
            policy = self.known.compile(text, self.file)
            self._policy = self.text, policy
        return self._policy[1]

    def allow(self, kind: RightKind, node: str, wide: str = "") -> tuple[str, ...]:
        """Add the rule, and return its lines. Raises `UngrantableError`."""
        request = Request(kind.host, node, kind.category, name_for(kind.name))
        key = wide or (kind.name if "*" in kind.name else "")
        change = grant(self.text, self.file, self.known, DecidedRequest(request, [Right(request)], wide=key))
        self.text = change.text
        return change.added

    def deny(self, kind: RightKind, node: str) -> None:
        """Add a test case that no later change may allow it."""
        host = str(kind.host)
        if any(kind.host in place for place in self._compile().robot):
            host = ROBOT
        named = node if is_global_name(node) else "/visitor"  # a tool has a name such as /rosparam-4711
        case = {"host": host, "node": named, "deny": [kind.action]}
        self.cases.append(case)
        self._denied.add((kind.category, name_for(kind.name), kind.host))

    def judge(self) -> None:
        """Raise `PolicyError` if the text or one of its cases is wrong."""
        cases = self.cases_text if self.cases else None
        known = replace(
            self.known, cases_file=f"{self.file}.tests.yaml", cases=cases, cases_error=None, site_keys=()
        )
        judge(self.text, self.file, known).accept()


def kinds_of(period: RecordedPeriod) -> Counter[tuple[RightKind, str]]:
    """Count the recorded requests by the rights that they needed, and by the node."""
    counts: Counter[tuple[RightKind, str]] = Counter()
    for observation in period.requests():
        try:
            requests = list(needed_rights(observation))
        except BadWordError:  # no rule can grant it
            continue
        for request in requests:
            name = lasting_name(request)
            counts[RightKind(request.category, name, request.host), request.caller_id] += observation.count
    return counts


def ask_rights(appliance: Appliance, period: RecordedPeriod, output: Path) -> int:
    """Ask about each kind on the terminal, and return the exit status."""
    beside = cases_beside(output)
    body = body_in_force(appliance)
    known = context_of(body)
    text, tests = body.text, ""
    if output.exists():
        text, tests = read_text(output), read_text(beside) if beside.exists() else ""
    elif beside.exists():
        text = f"{beside} exists already, but {output} does not: remove it or give another file"
        raise usage(text, verb="rosrv policy")
    try:
        cases = yaml.load(tests, yaml.BaseLoader) or {}  # noqa: S506  it only makes texts: a time stays as it is written
        asked = AskedPolicy(text, str(output), known, cases.get("given") or {}, cases.get("cases") or [])
    except PolicyError as error:
        raise refusal(error.findings) from error
    except (yaml.YAMLError, AttributeError) as error:
        raise refusal([f"{beside}: not a file of test cases: {error}"]) from error

    def keep() -> None:
        write_told(output, asked.text.encode())
        if asked.cases:
            write_told(beside, asked.cases_text.encode())

    def answer(kind: RightKind, node: str, count: int) -> Answer:
        who = appliance.host_in_words(str(kind.host))
        say(f"{node or 'a client'} on {who}: {_VERBS[kind.category]} {kind.name} ({count}x)", "bold")
        wider = f", [w]ider ({kind.wider})" if kind.wider else ""
        while True:
            letter = str(typer.prompt(f"  [a]llow, [d]eny{wider}, [l]ater, [q]uit", default="l", err=True))
            reply = _LETTERS.get(letter.strip().casefold()[:1])
            if reply is not None and (reply != "wider" or kind.wider):
                return reply

    kinds = kinds_of(period)
    for note in period.notes(appliance, "asked"):
        say(note, "yellow")
    answers = carry_out(asked, kinds, answer, keep)
    try:
        asked.judge()
    except PolicyError as error:
        raise refusal(
            [*error.findings, f"rosrv policy: {output} is written, and does not pass its checks (see above)"]
        ) from error
    allowed, later = answers["allow"] + answers["wider"], counted(answers["later"], "question")
    rest = "run it again for what is left" if answers["later"] or answers["quit"] else "nothing is new"
    say(f"{allowed} allowed, {answers['deny']} denied, {later} left for later; {rest}")
    if output.exists():
        say(f"next: rosrv policy diff {output} --decisions")
        say(f"then copy it to {body.policy_file}, and run: rosrv policy reload --confirm-within 5m")
    return 0


def carry_out(
    asked: AskedPolicy,
    counts: Counter[tuple[RightKind, str]],
    answer: Callable[[RightKind, str, int], Answer],
    keep: Callable[[], None],
) -> Counter[str]:
    """Carry out the answers until there is no new kind, or a person quits, and return their numbers."""
    answers: Counter[str] = Counter()
    for kind, node, count in asked.missing(counts):
        reply = answer(kind, node, count)
        answers[reply] += 1
        if reply == "quit":
            break
        if reply == "later":
            continue
        if reply == "deny":
            asked.deny(kind, node)
        else:
            try:
                added: Iterable[str] = asked.allow(kind, node, kind.wider if reply == "wider" else "")
            except UngrantableError as error:
                say(printable(f"  {error}"), "red")
                answers[reply] -= 1
                answers["later"] += 1
                continue
            for line in added:
                say(printable(f"  + {line}"), "green")
        keep()
    return answers


_SHOWN_NODES = 5


@speaks_with("One JSON object: the policy, and the number of requests it is based on")
def learn_policy(
    appliance: Appliance,
    *,
    since: Since = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            "--host", metavar="HOST", help="Only the requests of this address or network (repeatable)"
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help=f"File; must not exist, except with --ask, which continues it; {OR_STANDARD} (default)",
        ),
    ] = None,
    tests: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for test cases of the used rights; must not exist"),
    ] = None,
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask about each kind of right that the policy does not grant yet")
    ] = False,
    with_start: Annotated[
        bool,
        typer.Option(
            "--with-start",
            help="To nodes whose start is not in the log, also grant the rights that a start needs",
        ),
    ] = False,
    robot: Robot = None,
) -> None:
    """Write a policy that grants the requests in the audit log and no others.

    First run the robot with `audit-only = all` below [Options], and start its nodes once in that time. Exit status 1
    if the log has no requests, or if the log lacks the start of nodes that were adopted (see --with-start). Hosts get
    their names from /etc/hosts, and the hosts of the running appliance's robot become the group `robot`.

    --ask needs --output. It starts with the policy in force, asks on the terminal, and writes the changed policy with
    its tests.

    Example: rosrv policy learn --state /var/lib/rosrv --output learned.ini
    """
    if ask:
        if tests is not None or with_start or robot or output is None or output == STANDARD_OUTPUT:
            raise usage_error("--ask needs --output FILE, and has none of --tests, --with-start and --robot")
        raise typer.Exit(ask_rights(appliance, recorded_period(appliance, since, host), output))
    members = _members(appliance, networks_of(robot))
    period = recorded_period(appliance, since, host)
    learned = learn(period.requests(), members, names_of_hosts(), with_start=with_start)
    for note in period.notes(appliance, "learned"):
        typer.echo(f"rosrv: {note}", err=True)
    if not learned.requests:
        start = " of these hosts" * bool(host) + (f" since {since}" if since is not None else "")
        hint = "run the robot with `audit-only = all` below [Options] first"
        raise refusal([f"rosrv: the audit log has no allowed requests{start}: {hint}"])
    if learned.unstarted and not with_start:
        raise refusal([_not_started(learned)])
    _check(learned, members, tests_wanted=tests is not None or appliance.as_json)
    for file, text in ((output, learned.text), (tests, learned.tests)):
        if file is not None:
            write_new(file, text, verb="rosrv policy")
    if appliance.as_json:
        counts = {"requests": learned.requests, "left_out": learned.left_out}
        say_json(
            {
                **counts,
                "text": learned.text,
                "tests": learned.tests,
                "unstarted": list(learned.unstarted),
                "removed": period.removed,
                "unnamed": period.unnamed,
            }
        )
        return
    if output is None:
        sys.stdout.write(learned.text)
    summary = f"rosrv: learned from {counted(learned.requests, 'request')}"
    if learned.left_out:
        summary += f"; left out {counted(learned.left_out, 'request')} that no rule can grant"
    typer.echo(summary, err=True)


def _not_started(learned: LearnedPolicy) -> str:
    nodes = learned.unstarted
    more = f" and {len(nodes) - _SHOWN_NODES} more" if len(nodes) > _SHOWN_NODES else ""
    return (
        f"rosrv: {counted(len(nodes), 'node')} ran already when the appliance took over, so the log lacks what their"
        f" start needs, and a policy learned from it would deny the next start: {', '.join(nodes[:_SHOWN_NODES])}{more}"
        "; start the robot once in audit-only mode, or add --with-start"
    )


def _members(appliance: Appliance, robot: list[Network]) -> list[Network]:
    try:
        own = running_robot(appliance)
    except NotRunningError:
        return robot
    members = [given for given in robot if is_covered(given, own)]
    group = ", ".join(map(_shown, own)) or "empty"
    for other in robot:
        if other not in members:
            text = f"rosrv: {_shown(other)} stays an address: the group robot of this appliance is {group}"
            typer.echo(text, err=True)
    return members if robot else own


def _shown(network: Network) -> str:
    return str(network.network_address) if network.num_addresses == 1 else str(network)


def _check(learned: LearnedPolicy, robot: list[Network], *, tests_wanted: bool) -> None:
    try:
        policy = compile_policy(learned.text, file="learned", robot=robot)
        testable = tests_wanted or len(learned.tests) <= MAXIMUM_CHARACTERS
        results = run_cases(policy, learned.tests, "learned.tests.yaml") if testable else []
    except PolicyError as error:
        what = f"rosrv: the learned policy is invalid (see above): {_busiest(learned)}"
        raise refusal([*error.findings, what]) from error
    failed = [result for result in results if not result.passed]
    if failed:
        raise refusal([*failed, "rosrv: the learned policy does not grant what was used (see above)"])


def _busiest(learned: LearnedPolicy) -> str:
    """Return what to do about too many names, of which one host has most."""
    stars = [hosts for key, hosts in learned.keys if "*/" in key]
    crowd = stars if len(stars) > MAXIMUM_INNER_STARS else [hosts for _, hosts in learned.keys]
    host, count = Counter(host for hosts in crowd for host in hosts).most_common(1)[0]
    return (
        f"{host} needs {count} of the {counted(len(crowd), 'key')}; learn from the other hosts"
        " (--host HOST for each), or write rules for these names by hand"
    )
