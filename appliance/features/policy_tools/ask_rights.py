"""Extend a policy by questions to a person: one for each kind of right that recorded requests needed and it denies.

An answer is a line of the policy, or a test case: what a person denied is a `deny` case, so the next run does not ask
again. Both files are written after each answer.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import typer
import yaml

from appliance.base.counted import counted
from appliance.cli.connection.target import Appliance
from appliance.cli.output import usage_error as usage
from appliance.cli.output import write_told
from appliance.features.policy_tools.audit_only import EnforceError, enforced
from appliance.features.policy_tools.grant import DecidedRequest, UngrantableError, grant
from appliance.features.policy_tools.learn import ROBOT, lasting_name, needed_rights
from appliance.features.policy_tools.policy_impact import cases_beside
from appliance.features.policy_tools.policy_input import body_in_force, context_of, read_text
from appliance.features.policy_tools.recorded_requests import RecordedPeriod
from appliance.policy.actions import VERBS, BadWordError
from appliance.policy.cases import run_cases
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import Right, decide_right
from appliance.policy.sections import PARAMETERS
from rosmop.tool.terminal import printable, refused, say

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
        return f"{_VERBS[self.category]} {self.name.replace('*', '1')}"

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
            results = run_cases(self._compiled(), self.cases_text, f"{self.file}.tests.yaml")
            denied = (result.request for result in results if result.expected == "deny")
            self._denied |= {(request.category, request.resource, request.host) for request in denied}
        members = [str(place.network_address) for place in self._compiled().robot]
        if members:
            self.given.setdefault("robot", members)

    @property
    def cases_text(self) -> str:
        given = {"given": self.given} if self.given else {}
        return yaml.safe_dump({**given, "cases": self.cases}, sort_keys=False)

    def _compiled(self) -> Policy:
        return self.known.compiled(self.text, self.file)

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
        name = kind.name.replace("*", "1")
        if (kind.category, name, kind.host) in self._denied:
            return False
        policy = self._enforced()
        if kind.category in PARAMETERS and kind.category not in policy.present:
            return False
        decision = decide_right(policy, Right(Request(kind.host, "", kind.category, name)))
        return not decision.allowed and decision.asks is None

    def _enforced(self) -> Policy:
        if self._policy is None or self._policy[0] != self.text:
            try:
                text = enforced(self.text).text
            except EnforceError:  # it is enforced already
                text = self.text
            policy = self.known.compiled(text, self.file)
            self._policy = self.text, policy
        return self._policy[1]

    def allow(self, kind: RightKind, node: str, wide: str = "") -> tuple[str, ...]:
        """Add the rule, and return its lines. Raises `UngrantableError`."""
        request = Request(kind.host, node, kind.category, kind.name.replace("*", "1"))
        key = wide or (kind.name if "*" in kind.name else "")
        change = grant(self.text, self.file, self.known, DecidedRequest(request, [Right(request)], wide=key))
        self.text = change.text
        return change.added

    def deny(self, kind: RightKind, node: str) -> None:
        """Add a test case that no later change may allow it."""
        host = str(kind.host)
        if any(kind.host in place for place in self._compiled().robot):
            host = ROBOT
        case = {"host": host, "node": node or "/visitor", "deny": [kind.action]}
        self.cases.append(case)
        self._denied.add((kind.category, kind.name.replace("*", "1"), kind.host))

    def judged(self) -> None:
        """Raise `PolicyError` if the text or one of its cases is wrong."""
        cases = self.cases_text if self.cases else None
        known = replace(
            self.known, cases_file=f"{self.file}.tests.yaml", cases=cases, cases_error=None, site_keys=()
        )
        judge(self.text, self.file, known).accepted()


def kinds_of(period: RecordedPeriod) -> Counter[tuple[RightKind, str]]:
    """Count the recorded requests by the rights that they needed, and by the node."""
    counts: Counter[tuple[RightKind, str]] = Counter()
    for recorded in period.requests():
        try:
            requests = list(needed_rights(recorded.observation))
        except BadWordError:  # no rule can grant it
            continue
        for request in requests:
            name = lasting_name(request)
            counts[RightKind(request.category, name, request.host), request.caller_id] += recorded.count
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
        cases = yaml.safe_load(tests) or {}
        asked = AskedPolicy(text, str(output), known, cases.get("given") or {}, cases.get("cases") or [])
    except PolicyError as error:
        raise refused(error.findings) from error
    except (yaml.YAMLError, AttributeError) as error:
        raise refused([f"{beside}: not a file of test cases: {error}"]) from error

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

    answers = carry_out(asked, kinds_of(period), answer, keep)
    try:
        asked.judged()
    except PolicyError as error:
        raise refused(
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
