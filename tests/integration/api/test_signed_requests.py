"""Signed requests over REST: from `rosrv`, from a script, and manipulated in transit."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.signing.request_signing import HEADER, proof_of, reading_key, statement
from tests.support.appliance import Appliance
from tests.support.command import rosrv
from tests.support.rest import Answer


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """Run an appliance that accepts no change with a bare token."""
    config = tmp_path_factory.mktemp("strict") / "appliance.yaml"
    config.write_text("api_require_proof: true\n")
    with Appliance(options=("--api", "127.0.0.1:0", "--config", str(config))) as appliance:
        yield appliance


class Holder:
    """A user's script that holds a token and never sends it."""

    def __init__(self, appliance: Appliance) -> None:
        whole = appliance.rest()
        assert whole.token is not None
        self.token = whole.token
        self.rest = whole.with_token(reading_key(self.token))

    def signed(self, method: str, target: str, body: bytes, headers: dict[str, str]) -> dict[str, str]:
        """Return the headers of a request, with its proof."""
        challenge = self.rest.get("/v1/challenge").json["challenge"]
        stated = statement(
            challenge,
            method=method,
            target=target,
            if_match=headers.get("If-Match", ""),
            content_type=headers.get("Content-Type", ""),
            body=body,
        )
        return headers | {HEADER: proof_of(self.token, challenge, stated)}

    def load(self, text: str, target: str = "/v1/policy") -> tuple[dict[str, str], Answer]:
        """Load a policy; return the request and the answer."""
        headers = self.signed("POST", target, text.encode(), {"If-Match": "*", "Content-Type": "text/plain"})
        return headers, self.rest.request("POST", target, text.encode(), headers)


def test_a_script_changes_a_policy_without_sending_its_token(running: Appliance) -> None:
    """A signed request is carried out under the token's name; without the proof it is refused."""
    holder = Holder(running)
    text = running.policy_file.read_text() + "\n# signed\n"
    _headers, answer = holder.load(text)
    assert (answer.status, answer.json["loaded"]) == (200, True)
    assert holder.rest.get("/v1/policy").json["who"] == "first"
    bare = holder.rest.post("/v1/policy", text, match="*")
    assert (bare.status, "needs its proof" in bare.json["detail"]) == (403, True)


def run(appliance: Appliance, *arguments: str) -> dict[str, Any]:
    """Run a verb over REST, which must succeed, and return its output."""
    certificate = appliance.state / "api" / "certificate.pem"
    place = ("--api", str(appliance.ready["api"]), "--api-ca", str(certificate))
    done = rosrv(*arguments, "--json", *place, ROSRV_TOKEN=appliance.token)
    assert done.returncode == 0, done.stderr + done.stdout
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def test_with_required_proofs_a_bare_token_only_reads(strict: Appliance) -> None:
    """Every change with a bare token gets 403 with the remedy; reading, and `rosrv` over REST, work as before."""
    rest = strict.rest()
    text = strict.policy_file.read_text()
    for method, path, body in (
        ("POST", "/v1/policy", text),
        ("POST", "/v1/policy/reload", ""),
        ("POST", "/v1/monitors/reload", ""),
        ("POST", "/v1/hosts/reload", ""),
        ("DELETE", "/v1/tokens/first", ""),
    ):
        headers = {"If-Match": "*", "Content-Type": "text/plain"}
        refused = rest.request(method, path, body.encode(), headers)
        assert refused.status == 403, (path, refused.body)
        assert "api_require_proof" in refused.json["detail"]
    assert rest.post("/v1/policy?dry_run=1", text).status == 200
    before = rest.get("/v1/policy").json["revision"]
    assert run(strict, "policy", "reload")["revision"] == before + 1
    assert run(strict, "policy", "rollback", str(before))["revision"] == before + 2
    strict.rosrv("token", "add", "bob", "--role", "viewer")
    assert run(strict, "token", "revoke", "bob")["name"] == "bob"
