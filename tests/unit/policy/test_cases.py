from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.policy.actions import VERBS
from appliance.policy.cases import CaseResult, run_cases
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from tests.support.examples import examples
from tests.unit.policy.mistakes import mistakes

POLICY = compile_policy(
    """[Groups]
ocu = host:ocu-1 10.0.0.5
[Nodes]
/joystick = ocu
[Publishers]
/cmd = ocu
[Commands]
default = robot
[Options]
audit-only = Commands
""",
    file="p.ini",
)


def run(text: str) -> list[CaseResult]:
    return run_cases(POLICY, text, "p.ini.tests.yaml")


def test_cases_pass_and_fail_with_their_place() -> None:
    results = run(
        "cases:\n" "  - host: 10.0.0.5\n" "    node: /joystick\n" "    allow: [publish /cmd]\n" "    deny:\n"
        "      - publish /cmd\n" "      - use-node /other\n"
    )  # fmt: skip
    assert [(r.line, r.column, r.passed) for r in results] == [(4, 13, True), (6, 9, False), (7, 9, True)]
    assert str(results[1]).startswith("p.ini.tests.yaml:6:9: expected deny: 10.0.0.5 may publish /cmd")


def test_given_addresses_stand_for_robot_and_enrolled_hosts() -> None:
    results = run(
        "given: {robot: 192.0.2.1, hosts: {ocu-1: 10.77.0.11}}\n"
        "cases:\n"
        "  - {host: [host:ocu-1, 10.0.0.5], node: /joystick, allow: [publish /cmd]}\n"
        "  - {host: robot, allow: [command getPid], deny: [use-node /joystick]}\n"
    )
    assert [str(r.request.host) for r in results] == ["10.77.0.11", "10.0.0.5", "192.0.2.1", "192.0.2.1"]
    assert all(r.passed for r in results)


def test_audit_only_counts_as_denial() -> None:
    assert run("cases: [{host: 10.9.9.9, deny: [command getPid]}]")[0].passed


@pytest.mark.parametrize(("text", "expected"), mistakes("cases"))
def test_a_mistake_in_the_cases_is_an_error_with_its_place(text: str, expected: str) -> None:
    with pytest.raises(PolicyError) as caught:
        run(text)
    shown = [f"{f.line}:{f.column}: {f.text}" for f in caught.value.findings]
    assert any(line.startswith(expected) for line in shown)


FULL = """
given: {robot: [192.0.2.1], hosts: {ocu-1: [10.77.0.11]}}
cases:
  - {host: [ocu, robot], node: /joystick, allow: [publish /cmd], deny: [call /a], ask: [call /b]}
  - {host: 10.0.0.5, deny: [call /a]}
"""
PLACES = (
    "", "given", "given robot", "given hosts", "given hosts ocu-1", "cases", "cases 0", "cases 0 host",
    "cases 0 allow", "cases 0 deny", "cases 0 ask",
)  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("value", [{}, [], None])
def test_an_empty_part_is_an_error_and_never_fewer_checks(value: object, place: str) -> None:
    assert len(run(FULL)) == 10
    tree = {"file": yaml.safe_load(FULL)}
    *path, last = (int(word) if word.isdigit() else word for word in f"file {place}".split())
    inner: Any = tree
    for step in path:
        inner = inner[step]
    inner[last] = value
    with pytest.raises(PolicyError):
        run(yaml.safe_dump(tree["file"]))


def test_yaml_aliases_cannot_multiply_cases() -> None:
    hosts = ", ".join(["10.0.0.1"] * 1000)
    text = f"cases:\n  - {{host: [{hosts}], allow: &a [{', '.join(['call /x'] * 1000)}]}}\n"
    with pytest.raises(PolicyError, match="more than 100000 checks"):
        run(text)


WORDS = "cases: given: host: node: allow: deny: - [ ] { } , /a ::1 robot & *a &a !!x"
PIECES = [*VERBS, *WORDS.split(), "\n  "]


@settings(max_examples=examples(200))
@given(st.one_of(st.text(), st.lists(st.sampled_from(PIECES), max_size=40).map(" ".join)))
def test_any_text_gives_results_or_a_policy_error(text: str) -> None:
    try:
        assert run(text)
    except PolicyError as error:
        assert error.findings
