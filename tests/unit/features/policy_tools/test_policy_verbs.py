import json
from pathlib import Path

import pytest

from appliance.policy.actions import VERBS
from tests.support.command import rosrv

POLICIES = Path(__file__).parents[4] / "policies"


@pytest.mark.parametrize("file", sorted(POLICIES.glob("*.ini")), ids=lambda file: file.name)
def test_shipped_policies_are_valid_and_pass_their_cases(file: Path) -> None:
    checked = rosrv("policy", "check", str(file), "--robot", "192.0.2.1", "--json")
    assert (checked.returncode, checked.stdout) == (0, "")
    assert rosrv("policy", "test", str(file)).returncode == 0


@pytest.mark.parametrize("verb", VERBS)
def test_explain_has_an_option_for_every_action(tmp_path: Path, verb: str) -> None:
    file = tmp_path / "p.ini"
    file.write_text("[Nodes]\n/ocu = *\n")
    resource = "shutdown" if verb == "command" else "/cmd"
    asked = rosrv(
        "policy", "explain", str(file), "--host", "::1", "--node", "/ocu", f"--{verb}", resource, "--json"
    )
    assert json.loads(asked.stdout)["category"] == VERBS[verb], asked.stderr
