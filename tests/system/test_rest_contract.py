import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.processes import LIMIT
from tests.support.rest import Rest

SCHEMATHESIS = str(Path(sys.executable).parent / "schemathesis")
PATIENCE = 8 * LIMIT  # it takes half a minute on an idle machine
PHASES = ("Examples", "Coverage", "Fuzzing", "Stateful")
CONFIG = """\
api: 127.0.0.1:0
api_tls: off
api_limits: {requests_per_second: 100000, burst: 1000000, failures_per_minute: 1000000}
"""


@pytest.fixture
def appliance(tmp_path: Path) -> Iterator[Appliance]:
    config = tmp_path / "appliance.yaml"
    config.write_text(CONFIG)
    with Appliance(options=("--config", str(config))) as running:
        yield running


def shown(said: str) -> str:
    return "\n".join(
        line if len(line) < 300 else f"{line[:280]} ... ({len(line)})" for line in said.splitlines()
    )


# A body beyond the size limit is refused before its form is checked.
REFUSED = """\
[checks.negative_data_rejection]
expected-statuses = ["400", "401", "403", "404", "405", "406", "409", "413", "415", "422", "428", "429", "5xx"]
"""


def fuzz(rest: Rest, directory: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    (directory / "schemathesis.toml").write_text(REFUSED)
    command = [SCHEMATHESIS, "run", f"{rest.url.geturl()}/v1/openapi.json", "--no-color"]
    command += ["--request-timeout", str(2 * LIMIT), "-H", f"Authorization: Bearer {rest.token}"]
    # The same cases in every run, however fast the machine is.
    command += ["--seed", "1", "--max-examples", "20", *flags]
    return subprocess.run(
        command, cwd=directory, capture_output=True, text=True, timeout=PATIENCE, check=False
    )


def test_the_contract_is_true(appliance: Appliance, tmp_path: Path) -> None:
    """No answer is a server error or outside the contract, and requests that break the contract are rejected.

    Not covered are: acceptance of every well-formed request, because a schema cannot define a valid policy; the
    streams, which do not end; the revocation of a token, because the fuzzer would revoke its own; and a new door,
    which needs isolation.
    """
    rest = appliance.rest()
    assert rest.get("/healthz").status == 200
    done = fuzz(
        rest, tmp_path, "--exclude-checks", "positive_data_acceptance", "--exclude-path", "/v1/audit/stream",
        "--exclude-path", "/v1/live", "--exclude-operation-id", "revoke_token",
        "--exclude-operation-id", "add_door",
    )  # fmt: skip
    assert done.returncode == 0, shown(done.stdout + done.stderr)
    assert [phase for phase in PHASES if f"✅ {phase}" not in done.stdout] == [], shown(done.stdout)
    rows = appliance.status()["processes"]
    assert [row["restarts"] for row in rows if row["role"] in ("control", "api")] == [0, 0]
    assert rest.get("/v1/status").status == 200


def test_the_fuzzer_finds_a_difference(appliance: Appliance, tmp_path: Path) -> None:
    rest = appliance.rest()
    contract = rest.get("/v1/openapi.json").json
    contract["paths"] = {"/v1/status": contract["paths"]["/v1/status"]}
    contract["components"]["schemas"]["Status"]["properties"]["nodes"] = {"type": "string"}
    contract["servers"] = [{"url": rest.url.geturl()}]
    (tmp_path / "contract.json").write_text(json.dumps(contract))
    command = [SCHEMATHESIS, "run", str(tmp_path / "contract.json"), "--url", rest.url.geturl(), "--no-color"]
    command += ["-H", f"Authorization: Bearer {rest.token}", "--max-examples", "5"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1
    assert "/v1/status" in done.stdout
