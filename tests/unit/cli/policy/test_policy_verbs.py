"""`rosrv policy check|explain|test|diff` as an operator uses them."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from appliance.audit.log import AuditLog
from appliance.audit.record import Record
from appliance.cli.main import app
from appliance.policy.actions import VERBS

POLICIES = Path(__file__).parents[4] / "policies"

POLICY = """[Groups]
ocu = 10.0.0.5
[Nodes]
/ocu = ocu
[Publishers]
/cmd = ocu
[Subscribers]
default = ocu
[Commands]
default = ocu
"""


def rosrv(*arguments: str | Path) -> Result:
    """Run `rosrv policy` with arguments."""
    return CliRunner().invoke(app, ["policy", *map(str, arguments)])


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A right policy in a file."""
    file = tmp_path / "p.ini"
    file.write_text(POLICY)
    return file


@pytest.mark.parametrize("file", sorted(POLICIES.glob("*.ini")), ids=lambda file: file.name)
def test_policies_that_are_shipped_are_right_and_pass_their_cases(file: Path) -> None:
    """Every policy in policies/ has neither errors nor warnings, and cases that all pass."""
    checked = rosrv("check", file, "--robot", "192.0.2.1", "--json")
    assert (checked.exit_code, checked.stdout) == (0, "")
    assert rosrv("test", file).exit_code == 0


def test_check_lists_findings_and_fails_on_errors(tmp_path: Path) -> None:
    """Errors and warnings come as NDJSON with their place; the exit status is 1 for errors only."""
    file = tmp_path / "p.ini"
    file.write_text("[Nodes]\nx = *\n")
    result = rosrv("check", file, "--json")
    assert result.exit_code == 1
    finding = json.loads(result.stdout.splitlines()[0])
    assert (finding["file"], finding["line"], finding["column"], finding["severity"]) == (
        str(file),
        2,
        1,
        "error",
    )
    assert f"{file}:2:1: error: " in rosrv("check", file).stdout
    file.write_text("[Nodes]\ndefault = *\n")
    warned = rosrv("check", file, "--json")
    assert warned.exit_code == 0
    assert {json.loads(line)["severity"] for line in warned.stdout.splitlines()} == {"warning"}


@pytest.mark.parametrize("verb", VERBS)
def test_explain_has_an_option_for_every_deed(policy: Path, verb: str) -> None:
    """What a case of a policy can say is asked the same way on the command line."""
    resource = "shutdown" if verb == "command" else "/cmd"
    asked = rosrv("explain", policy, "--host", "10.0.0.9", "--node", "/ocu", f"--{verb}", resource, "--json")
    assert json.loads(asked.stdout)["category"] == VERBS[verb], asked.stderr


def test_explain_answers_by_exit_status_and_text(policy: Path) -> None:
    """Allowed is 0, denied is 1; the text has the decision, the rule and the node rule."""
    allowed = rosrv("explain", policy, "--host", "10.0.0.5", "--node", "/ocu", "--publish", "/cmd")
    assert allowed.exit_code == 0
    assert "[Publishers] /cmd" in allowed.stdout
    assert "together: allowed" in allowed.stdout
    denied = rosrv("explain", policy, "--host", "10.0.0.9", "--command", "shutdown", "--json")
    assert denied.exit_code == 1
    found = json.loads(denied.stdout)
    assert found["decision"] == "deny"
    assert found["rule"] == {"section": "Commands", "key": "default", "file": str(policy), "line": 10}


@pytest.mark.parametrize(
    "arguments",
    [
        ["--host", "10.0.0.5"],
        ["--host", "10.0.0.5", "--publish", "/a"],
        ["--host", "nobody", "--call", "/a"],
        ["--host", "robot", "--call", "/a"],
        ["--host", "10.0.0.5", "--call", "/a", "--command", "getPid"],
        ["--host", "10.0.0.5", "--command", "getpid"],
        ["--host", "10.0.0.5", "--call", "a"],
        ["--host", "10.0.0.5", "--call", "/a", "--robot", "x"],
        ["--host", "10.0.0.5", "--call", "/a", "--enrolled", "x"],
    ],
)
def test_wrong_use_is_status_2_and_a_sentence(policy: Path, arguments: list[str]) -> None:
    """What cannot be asked is a usage error with one sentence on standard error, never a traceback."""
    result = rosrv("explain", policy, *arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith("rosrv policy: ")
    assert "Traceback" not in result.output


def test_enrolled_host_and_robot_can_be_given(policy: Path) -> None:
    """--robot and --enrolled say who robot and host:NAME are."""
    policy.write_text(POLICY.replace("ocu = 10.0.0.5", "ocu = robot host:ocu-1"))
    given = ["--robot", "192.0.2.1", "--enrolled", "ocu-1=10.77.0.11", "--command", "getPid"]
    assert rosrv("explain", policy, "--host", "robot", *given).exit_code == 0
    assert rosrv("explain", policy, "--host", "host:ocu-1", *given).exit_code == 0
    assert rosrv("explain", policy, "--host", "10.77.0.12", *given).exit_code == 1


def test_test_runs_the_cases_beside_the_policy(policy: Path) -> None:
    """Failing cases are listed with their place and make the exit status 1; without cases it is 2."""
    assert rosrv("test", policy).exit_code == 2
    cases = policy.with_name("p.ini.tests.yaml")
    cases.write_text("cases:\n  - host: 10.0.0.5\n    allow: [command getPid]\n    deny: [command getUri]\n")
    result = rosrv("test", policy)
    assert result.exit_code == 1
    assert f"{cases}:4:12: expected deny:" in result.stdout
    assert "1 passed, 1 failed" in result.stdout
    lines = [json.loads(line) for line in rosrv("test", policy, "--json").stdout.splitlines()]
    assert [line["passed"] for line in lines] == [True, False]
    cases.write_text("cases: x\n")
    assert rosrv("test", policy).exit_code == 1


def test_diff_reads_requests_and_lists_what_changes(policy: Path, tmp_path: Path) -> None:
    """Requests from a file that the new policy decides differently are listed; none is status 0."""
    new = tmp_path / "new.ini"
    new.write_text(POLICY.replace("/cmd = ocu", "/cmd = 10.0.0.6"))
    requests = tmp_path / "requests.ndjson"
    row = {"host": "10.0.0.5", "caller_id": "/ocu", "category": "publish", "resource": "/cmd"}
    requests.write_text(json.dumps(row) + "\n\n" + json.dumps({**row, "category": "subscribe"}) + "\n")
    result = rosrv("diff", policy, new, "--requests", requests, "--json")
    assert result.exit_code == 1
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(one["resource"], one["old"]["decision"], one["new"]["decision"]) for one in found] == [
        ("/cmd", "allow", "deny")
    ]
    assert rosrv("diff", policy, policy, "--requests", requests).exit_code == 0
    assert rosrv("diff", policy, new).exit_code == 2
    requests.write_text('{"host": 1}\n')
    broken = rosrv("diff", policy, new, "--requests", requests)
    assert broken.exit_code == 2
    assert f"{requests}:1: not a request" in broken.stderr


def test_diff_reads_the_audit_log(policy: Path, tmp_path: Path) -> None:
    """Without a file of requests, diff decides anew what the audit log of the state directory has seen."""
    new = tmp_path / "new.ini"
    new.write_text(POLICY.replace("/cmd = ocu", "/cmd = 10.0.0.6"))
    (tmp_path / "control").mkdir()
    log = AuditLog(tmp_path / "control" / "audit.db")
    for number, resource in enumerate(["/cmd", "/cmd", "/other"]):
        record = Record(
            id=f"r{number}",
            time=number,
            event="decision",
            decision="allow",
            host="10.0.0.5",
            caller_id="/ocu",
            category="publish",
            resource=resource,
        )
        log.record(record)
    log.record(Record(id="r9", time=9, event="policy reloaded"))
    assert log.close() is None
    result = rosrv("diff", policy, new, "--state", tmp_path, "--json")
    assert [
        (json.loads(line)["resource"], json.loads(line)["count"]) for line in result.stdout.splitlines()
    ] == [("/cmd", 2)]
    missing = rosrv("diff", policy, new, "--state", tmp_path / "none")
    assert missing.exit_code == 2
    assert "rosrv policy: " in missing.stderr


def test_policy_with_errors_is_refused_by_every_verb(policy: Path) -> None:
    """explain, test and diff print the errors with their places and end with status 1."""
    policy.write_text("[Nodes]\nx = *\n")
    for verb, *arguments in (["explain", "--host", "::1", "--call", "/a"], ["test"]):
        result = rosrv(verb, policy, *arguments)
        assert result.exit_code == 1
        assert ":2:1: error: " in result.stderr


def test_control_characters_reach_no_terminal(tmp_path: Path) -> None:
    """Escape sequences in a file or its name are shown escaped."""
    file = tmp_path / "p\x1b[31m.ini"
    file.write_bytes(b"[Nodes]\n/\x1b]0;x\x07 = *\n\xff = *\n")
    result = rosrv("check", file)
    assert result.exit_code == 1
    assert "\x1b" not in result.output
    assert "\x07" not in result.output
