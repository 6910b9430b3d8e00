import json
from pathlib import Path
from unittest import mock

import pytest

from appliance.features.policy_tools import learn_verb
from appliance.policy import cases
from appliance.policy.actions import VERBS
from appliance.policy.rules import MAXIMUM_INNER_STARS
from tests.support.audit import decision
from tests.support.command import rosrv
from tests.support.engines import open_log

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


@pytest.mark.real
def test_one_host_with_too_many_names_prevents_no_learning_from_the_others(tmp_path: Path) -> None:
    """The error names that host and the option, and test cases that are not written have no limit."""
    file = tmp_path / "control" / "audit.db"
    file.parent.mkdir()
    log = open_log(file)
    for number in range(MAXIMUM_INNER_STARS + 1):
        name = f"/a{number}_4711_1700000000000/state"
        log.record(
            decision(log, number, host="10.0.0.66", caller_id="/evil", resource=name, decision="would deny")
        )
    for host in ("10.0.0.5", "10.0.1.6"):
        log.record(decision(log, 1, host=host, caller_id="/pad", resource="/pad_4711_1700000000000/state"))
    assert log.close() is None
    learn = ("policy", "learn", "--state", str(tmp_path))
    refused = rosrv(*learn)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert (
        f"10.0.0.66 needs {MAXIMUM_INNER_STARS + 1} of the {MAXIMUM_INNER_STARS + 2} keys" in refused.stderr
    )
    assert "--host HOST" in refused.stderr
    learned = rosrv(*learn, "--host", "10.0.0.5", "--host", "10.0.1.0/24")
    assert "hosts-1 = 10.0.0.5 10.0.1.6\n" in learned.stdout and "/pad_*/state = hosts-1" in learned.stdout
    assert "10.0.0.66" not in learned.stdout and "/a1_" not in learned.stdout
    none = rosrv(*learn, "--host", "10.9.9.9")
    assert none.returncode == 1 and "no allowed requests of these hosts" in none.stderr
    assert "--host: 'pad' does not appear to be" in rosrv(*learn, "--host", "pad").stderr
    few = (*learn, "--host", "10.0.0.5")
    with (
        mock.patch.object(cases, "MAXIMUM_CHARACTERS", 10),
        mock.patch.object(learn_verb, "MAXIMUM_CHARACTERS", 10),
    ):
        assert rosrv(*few).returncode == 0
        for wants in (["--json"], ["--tests", str(tmp_path / "tests.yaml")]):
            assert "limit is 10" in rosrv(*few, *wants).stderr
