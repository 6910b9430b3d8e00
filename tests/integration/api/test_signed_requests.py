from appliance.signing.request_signing import HEADER, proof_of, reading_key, statement
from tests.support.appliance import Appliance


def test_a_script_changes_a_policy_without_sending_its_token(running: Appliance) -> None:
    whole = running.rest()
    assert whole.token is not None
    rest = whole.with_token(reading_key(whole.token))
    body = (running.policy_file.read_text() + "\n# signed\n").encode()
    headers = {"If-Match": "*", "Content-Type": "text/plain"}
    challenge = rest.get("/v1/challenge").json["challenge"]
    stated = statement(
        challenge, method="POST", target="/v1/policy", if_match="*", content_type="text/plain", body=body
    )
    proof = {HEADER: proof_of(whole.token, challenge, stated)}
    answer = rest.request("POST", "/v1/policy", body, headers | proof)
    assert (answer.status, answer.json["loaded"]) == (200, True)
    assert rest.get("/v1/policy").json["who"] == "first"
    bare = rest.request("POST", "/v1/policy", body, headers)
    assert (bare.status, "needs its proof" in bare.json["detail"]) == (403, True)
