"""Decisions as text: a policy, followed by requests with their verdicts (`decisions.txt`).

> 10.0.0.1 publish, subscribe /a, /b: deny by [Publishers] /a     each category with each name, and the rule
> 10.0.0.1 as /node publish /a: allow                              the node's name as well
> 10.0.0.1 write all /a: deny                                      a call on the key and all below it
> 10.0.0.1 write inside /a: deny                                   the same while the key is a namespace
"""

import ipaddress
import re
from itertools import product
from pathlib import Path

import pytest

from appliance.policy.model import Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import decide, rights_of

_TEXTS = (
    Path(__file__).with_name("decisions.txt").read_text(encoding="utf-8").removeprefix("# ").split("\n\n# ")
)
_CASES = dict(text.strip().split("\n", 1) for text in _TEXTS)
_LINE = re.compile(
    r"> (?P<host>\S+)( as (?P<node>\S+))? (?P<categories>\w+(, \w+)*)( (?P<how>all|inside))? (?P<names>\S.*?): "
    r"(?P<verdict>allow|deny|would deny)( by \[(?P<section>\w+)\] (?P<key>.+))?"
)


def decided(policy: Policy, line: re.Match[str], category: str, name: str) -> Decision:
    node, how = line["node"], line["how"]
    request = Request(ipaddress.ip_address(line["host"]), (node or "/n").strip('"'), Category(category), name)
    if how is not None:
        return policy.decide_parameter(request, namespace=how == "inside")
    return policy.decide(request) if node is None else decide(policy, rights_of(request))


@pytest.mark.parametrize("title", _CASES)
def test_decisions(title: str) -> None:
    lines = _CASES[title].splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("> "))
    policy = compile_policy("\n".join(lines[:first]), file="p.ini")
    for line in (line for line in lines[first:] if line.startswith(">")):
        asked = _LINE.fullmatch(line)
        assert asked is not None, line
        for category, name in product(asked["categories"].split(", "), asked["names"].split(", ")):
            found = decided(policy, asked, category, name)
            verdict = "would deny" if found.would_deny else "allow" if found.allowed else "deny"
            assert verdict == asked["verdict"], (line, category, name)
            if asked["key"] is not None:
                assert found.rule is not None, line
                assert (found.rule.section, found.rule.key) == (asked["section"], asked["key"]), (line, name)
