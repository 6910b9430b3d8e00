import contextlib
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.processes import Process
from tests.support.rest import Answer
from tests.support.site_key import LINE, NAME, OTHER_KEY, signed
from tests.support.waiting import eventually

OTHER = OPEN_POLICY.replace("[Subscribers]", "/chatter =\n[Subscribers]", 1)
SPECIFICATION = "count() { event said() /chatter std_msgs/String '{}' { } }\n"
NO_SIGNATURE = "it has no signature of the site (site_keys in appliance.yaml)"


@contextlib.contextmanager
def of_a_site() -> Iterator[Appliance]:
    options = ("--api", "127.0.0.1:0", "--api-tls", "off")
    appliance = Appliance(settings=f"site_keys:\n  - {LINE}\n", monitors={}, options=options)
    sign(appliance.policy_file)
    try:
        yield appliance
    finally:
        appliance.close()


@pytest.fixture(scope="module")
def started() -> Iterator[Appliance]:
    with of_a_site() as appliance:
        yield appliance.start()


def sign(file: Path) -> None:
    file.with_name(f"{file.name}.sig").write_text(signed(file.read_text()))


def post(appliance: Appliance, path: str, **body: Any) -> Answer:
    headers = {"If-Match": "*", "Content-Type": "application/json"}
    return appliance.rest().request("POST", path, json.dumps(body).encode(), headers)


def in_force(appliance: Appliance) -> dict[str, Any] | None:
    answer = appliance.rest().get("/v1/policy")
    return answer.json if answer.status == 200 else None


def test_an_unsigned_policy_fails_the_start() -> None:
    with of_a_site() as appliance:
        Path(f"{appliance.policy_file}.sig").unlink()
        with pytest.raises(AssertionError, match="ended"):
            appliance.start()
        assert isinstance(appliance.process, Process)
        said = appliance.process.story()
        assert (
            f"{appliance.policy_file}:1:1: error: {NO_SIGNATURE}: sign it (rosrv sign FILE --key KEY)" in said
        )
        assert not appliance.state.exists()


def test_every_way_requires_the_signature_of_a_policy(started: Appliance) -> None:
    appliance = started
    appliance.policy_file.write_text(OTHER)
    assert "it is not the text that" in appliance.rosrv("policy", "reload", check=False).stderr
    assert isinstance(appliance.process, Process)
    appliance.process.popen.send_signal(signal.SIGHUP)
    appliance.recorded("--event", "policy refused", count=2)
    checked = appliance.rosrv("policy", "check", str(appliance.policy_file), check=False)
    assert (checked.returncode, "it is not the text that" in checked.stdout) == (1, True)
    for query in ("", "?dry_run=1"):
        for signature in ("", signed(OPEN_POLICY), signed(OTHER, OTHER_KEY)):
            refused = post(appliance, f"/v1/policy{query}", text=OTHER, signature=signature)
            assert (refused.status, refused.json["findings"][0]["line"]) == (422, 1), refused.body
    assert NO_SIGNATURE in post(appliance, "/v1/policy", text=OTHER).json["detail"]
    taken = post(appliance, "/v1/policy", text=OTHER, signature=signed(OTHER))
    assert taken.status == 200, taken.body
    appliance.rosrv("policy", "rollback")
    appliance.recorded("--event", "policy loaded", count=3)
    appliance.kill("control")
    state = eventually(lambda: in_force(appliance), appliance.story)
    assert (state["revision"], state["signature"], state["site_keys"]) == (3, signed(OPEN_POLICY), [LINE])
    records = appliance.audit("--event", "policy loaded", "--oldest-first")
    assert [record["detail"]["signed_by"] for record in records] == [NAME] * 3


def test_every_way_requires_the_signature_of_a_specification(started: Appliance) -> None:
    appliance = started
    file = appliance.directory / "monitors" / "count.rv"
    file.write_text(SPECIFICATION)
    for verb in (["load", str(file)], ["reload"]):
        assert f"count.rv:1:1: error: {NO_SIGNATURE}" in appliance.rosrv("monitor", *verb, check=False).stderr
    for query in ("", "?dry_run=1"):
        refused = post(appliance, f"/v1/monitors{query}", files={"count.rv": SPECIFICATION})
        assert (refused.status, NO_SIGNATURE in refused.json["detail"]) == (422, True)
    sign(file)
    appliance.rosrv("monitor", "load", str(file))
    appliance.rosrv("monitor", "remove", "count")
    appliance.rosrv("monitor", "reload")
    signatures = {"count.rv": signed(SPECIFICATION)}
    assert (
        post(appliance, "/v1/monitors", files={"count.rv": SPECIFICATION}, signatures=signatures).status
        == 200
    )
    shown = appliance.rest().get("/v1/monitors?texts=1").json
    assert (shown["signatures"], shown["site_keys"]) == (signatures, [LINE])
    records = appliance.audit("--event", "specifications loaded", "--oldest-first")
    assert [record["detail"]["signed_by"] for record in records] == [[NAME], [], [NAME], [NAME]]
