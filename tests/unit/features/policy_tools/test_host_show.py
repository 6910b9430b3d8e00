import json
from functools import partial
from typing import Any

import pytest
import typer

from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.features.policy_tools import policy_verbs
from tests.support.answers import example
from tests.support.memory_call import call_of

POLICY = """\
[Groups]
site = 10.77.0.0/24
[Nodes]
default = site door:alice
[Publishers]
default = site
/goal = site, ask door:alice
[Subscribers]
/odom = site door:alice
[Services]
[Clients]
[Parameters]
[Commands]
default = site
"""


GROUPS = """\
[Authority]
base = /cmd_vel
rank base = 10.77.0.5/pad > door:alice > 10.77.0.5
arm = /arm /arm/home
take arm = 10.77.0.5
ask arm = door:alice
"""


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Any:
    hosts = {"door:alice": "198.19.240.2"}
    policy = example(PolicyInForce, text=POLICY + GROUPS, file="site.ini", hosts=hosts)

    def show(name: str) -> tuple[int, list[str]]:
        with pytest.raises(typer.Exit) as left:
            policy_verbs.show_host.function(call_of(lambda _request: policy), name)
        return left.value.exit_code, capsys.readouterr().out.splitlines()

    return show


@pytest.mark.parametrize("name", ["door:alice", "alice"])
def test_the_rights_of_a_door_are_listed_by_its_name(shown: Any, name: str) -> None:
    status, lines = shown(name)
    assert status == 0
    assert lines[0] == "door:alice, by the policy in force:"
    assert len(lines) == 6
    assert "/goal" in lines[2]
    assert "needs an approval" in lines[2]


def test_a_host_without_rights_has_none_listed(shown: Any) -> None:
    assert shown("10.9.9.9") == (
        1,
        [
            "10.9.9.9, by the policy in force:",
            "no rule grants 10.9.9.9 anything",
            "[Authority] base (/cmd_vel): no part in it, so its messages and calls of these names are denied",
            "[Authority] arm (/arm /arm/home): no part in it, so its messages and calls of these names are denied",
        ],
    )


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("alice", ["rank 2 of 3 as door:alice;", "may only ask for it"]),
        (
            "10.77.0.5",
            ["rank 1 of 3 as 10.77.0.5/pad, rank 3 of 3 as 10.77.0.5;", "may take it while it is free"],
        ),
    ],
)
def test_the_rank_or_claim_of_a_host_in_each_group_is_listed(shown: Any, name: str, parts: list[str]) -> None:
    lines = shown(name)[1][-2:]
    assert all(part in line for part, line in zip(parts, lines, strict=True)), lines


def _same(policy: PolicyInForce, _request: object) -> PolicyInForce:
    return policy


def test_a_right_with_a_time_is_listed_with_it(capsys: pytest.CaptureFixture[str]) -> None:
    text = (
        "[Hours]\nnight = 22:00-06:00\n[Nodes]\ndefault = *\n[Publishers]\n/a = 10.0.0.5 until 2026-12-05\n"
        "/b = 10.0.0.5 during night\n/c = ask 10.0.0.5 until 2026-12-05\n[Subscribers]\n[Services]\n[Clients]\n"
        "[Parameters]\n[Commands]\ngetPid = *\n"
    )
    for now, status, expected in (
        (1_796_040_000.0, 0, ["/a allow until 2026-12-05", "/b deny its right during night", "/c ask until"]),
        (
            1_797_080_000.0,
            0,
            ["/a deny its right until 2026-12-05 has ended", "/b deny its right", "/c deny its right"],
        ),
        (None, 0, ["/a deny its right until 2026-12-05 waits", "/b deny its right", "/c deny its right"]),
    ):
        policy = example(PolicyInForce, text=text, file="site.ini", now=now)
        with pytest.raises(typer.Exit) as left:
            policy_verbs.show_host.function(call_of(partial(_same, policy), as_json=True), "10.0.0.5")
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        shown = [
            f"{row['rule']['key']} {row['decision']} {row.get('time', '')}" for row in rows if row.get("rule")
        ]
        assert left.value.exit_code == status
        for row, start in zip([one for one in shown if one.startswith("/")], expected, strict=True):
            assert row.startswith(start)
