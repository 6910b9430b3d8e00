"""Run the test cases of a policy (`FILE.tests.yaml`, docs/policy.md).

The policy is compiled with the `given` addresses, so its cases pass wherever it is deployed. A case without `at` is
decided as if each right with a time had begun and none had ended, so it passes whenever the policy is loaded.
"""

import ipaddress
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import yaml

from appliance.base.validation_messages import meant, not_yaml
from appliance.policy.actions import BadWordError, find_hosts, parse_action
from appliance.policy.host_sets import canonical_address
from appliance.policy.hours import instant
from appliance.policy.model import Address, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import Findings, FindingSeverity, Place, PolicyFinding, quote
from appliance.policy.rights import decide, needs_node, rights_of
from roswire.names import is_global_name

MAXIMUM_CHARACTERS = 1024 * 1024
MAXIMUM_CHECKS = 100_000

Expected = Literal["allow", "deny", "ask"]
_EXPECTED: tuple[Expected, ...] = ("allow", "deny", "ask")
_Node = yaml.nodes.Node
_Pairs = dict[str, tuple[_Node, _Node]]


@dataclass(frozen=True, slots=True)
class CaseResult:
    """The result of a test case; `line` and `column` count from 1."""

    file: str
    line: int
    column: int
    request: Request
    expected: Expected
    decision: Decision

    @property
    def passed(self) -> bool:
        """Whether the case passed; a request that passes only because of audit-only mode counts as denied."""
        verdict = self.decision.verdict
        return self.expected == ("deny" if verdict == "would deny" else verdict)

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.finding.text}"

    @property
    def finding(self) -> PolicyFinding:
        text = f"expected {self.expected}: {self.decision.reason}"
        return PolicyFinding(self.file, self.line, self.column, FindingSeverity.ERROR, text)


def run_cases(policy: Policy, text: str, file: str) -> list[CaseResult]:
    """Return the results. Raises `PolicyError` with all mistakes in the text.

    A file without cases is a mistake, because it would pass with every policy.
    """
    findings = Findings(file)
    reader = _CaseReader(policy, findings)
    results = list(reader.results(_compose(text, findings)))
    if not results:
        findings.error(Place(), "there is no case in this file: add one below cases:")
    findings.raise_errors()
    return results


def _compose(text: str, findings: Findings) -> _Node | None:
    if len(text) > MAXIMUM_CHARACTERS:
        findings.error(Place(), f"the file has {len(text)} characters; the limit is {MAXIMUM_CHARACTERS}")
        return None
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except RecursionError:
        findings.error(Place(), "the file is nested too deep")
    except yaml.MarkedYAMLError as fault:
        mark = fault.problem_mark or fault.context_mark
        place = Place(mark.line + 1, mark.column + 1) if mark else Place()
        findings.error(place, not_yaml(fault.problem or fault.context).removeprefix("is "))
    except yaml.YAMLError as fault:
        findings.error(Place(), f"not YAML: {quote(str(fault), 120)}")
    return None


class _CaseReader:
    def __init__(self, policy: Policy, findings: Findings) -> None:
        self._policy = policy.at_any_time()
        self._findings = findings
        self._checks = 0

    def results(self, root: _Node | None) -> Iterator[CaseResult]:
        if root is None:
            return
        top = self._mapping(root, "the file", ("given", "cases"))
        if "given" in top:
            self._give(top["given"][1])
        for case in self._sequence(top["cases"][1], "cases") if "cases" in top else ():
            yield from self._case(case)

    def _give(self, node: _Node) -> None:
        given = self._mapping(node, "given", ("robot", "hosts"))
        robot: list[Address] = list(self._addresses(given["robot"][1], "robot")) if "robot" in given else []
        hosts: dict[str, Address] = {}
        if "hosts" in given:
            for name, (_, value) in self._mapping(given["hosts"][1], "hosts", None).items():
                hosts.update((name, address) for address in self._addresses(value, quote(name)))
        policy = compile_policy(self._policy.text, file=self._policy.file, hosts=hosts, robot=robot)
        self._policy = policy.at_any_time()

    def _addresses(self, node: _Node, what: str) -> Iterator[Address]:
        for scalar in self._one_or_more(node, what):
            text = self._text(scalar, "an address")
            try:
                yield canonical_address(ipaddress.ip_address(text))
            except ValueError:
                self._error(scalar, f"{quote(text)} is not an IP address")

    def _case(self, node: _Node) -> Iterator[CaseResult]:
        case = self._mapping(node, "a case", ("host", "node", "at", *_EXPECTED))
        if not case:
            return
        hosts = list(self._hosts(node, case))
        caller_id = ""
        if "node" in case:
            caller_id = self._text(case["node"][1], "node")
            if not is_global_name(caller_id):
                self._error(case["node"][1], f"{quote(caller_id)} is not a node name, such as /joystick")
        policy = self._policy
        if "at" in case:
            try:
                policy = policy.at(instant(self._text(case["at"][1], "at"), policy.zone))
            except ValueError as fault:
                self._error(case["at"][1], str(fault))
        if case.keys().isdisjoint(_EXPECTED):
            self._error(node, "a case needs allow:, deny: or ask: with the actions of the host")
        for expected in _EXPECTED:
            for action in self._sequence(case[expected][1], expected) if expected in case else ():
                yield from self._check(policy, action, hosts, caller_id, expected)

    def _hosts(self, node: _Node, case: _Pairs) -> Iterator[Address]:
        if "host" not in case:
            self._error(node, "a case needs host: an address, robot or host:NAME")
            return
        for scalar in self._one_or_more(case["host"][1], "host"):
            text = self._text(scalar, "host")
            try:
                yield from find_hosts(text, self._policy)
            except BadWordError as fault:
                self._error(scalar, f"{fault}; addresses can be given below given:")

    def _check(
        self, policy: Policy, node: _Node, hosts: list[Address], caller_id: str, expected: Expected
    ) -> Iterator[CaseResult]:
        text = self._text(node, "what the host does")
        try:
            category, resource = parse_action(text)
        except BadWordError as fault:
            self._error(node, str(fault))
            return
        for host in hosts:
            self._checks += 1
            if self._checks > MAXIMUM_CHECKS:
                self._error(node, f"more than {MAXIMUM_CHECKS} checks in one file")
                return
            request = Request(host, caller_id, category, resource)
            if needs_node(request) and not caller_id:
                self._error(node, f"{quote(text)} makes a node part of the graph: the case needs node:")
                return
            decision = decide(policy, rights_of(request))
            line, column = node.start_mark.line + 1, node.start_mark.column + 1
            yield CaseResult(self._findings.file, line, column, request, expected, decision)

    # --- YAML with places ---

    def _mapping(self, node: _Node, what: str, keys: tuple[str, ...] | None) -> _Pairs:
        pairs: _Pairs = {}
        if not isinstance(node, yaml.MappingNode):
            expected = f" with {', '.join(keys)}" if keys else ""
            self._error(node, f"{what} is a mapping{expected}")
            return pairs
        self._not_empty(node, what)
        for key, value in node.value:
            text = self._text(key, "a key")
            if keys is not None and text not in keys:
                guess = meant(text, keys) or f"; {what} has {', '.join(keys)}"
                self._error(key, f"unknown key {quote(text)}{guess}")
            elif text in pairs:
                self._error(key, f"the key {quote(text)} is repeated")
            else:
                pairs[text] = (key, value)
        return pairs

    def _sequence(self, node: _Node, what: str) -> list[_Node]:
        if isinstance(node, yaml.SequenceNode):
            self._not_empty(node, what)
            items: list[_Node] = node.value
            return items
        self._error(node, f"{what} is a list")
        return []

    def _one_or_more(self, node: _Node, what: str) -> list[_Node]:
        return self._sequence(node, what) if isinstance(node, yaml.SequenceNode) else [node]

    def _not_empty(self, node: yaml.CollectionNode, what: str) -> None:
        if not node.value:  # it would test less than its author believes
            self._error(node, f"{what} is empty: fill it, or remove it")

    def _text(self, node: _Node, what: str) -> str:
        if isinstance(node, yaml.ScalarNode):
            return str(node.value)
        self._error(node, f"{what} is one word or line here")
        return ""

    def _error(self, node: _Node, text: str) -> None:
        self._findings.error(Place(node.start_mark.line + 1, node.start_mark.column + 1), text)
