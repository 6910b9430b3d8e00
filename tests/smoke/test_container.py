import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.docker import Compose, Engine, build_images, project
from tests.support.requirements import need_root
from tests.support.rest import Rest
from tests.support.waiting import eventually

pytestmark = [pytest.mark.real, pytest.mark.timeout(1500)]  # the images are built first

TABLET = "172.29.78.66"


@pytest.fixture(scope="module")
def machine() -> Iterator[Host]:
    need_root()
    build_images()
    with Lab("rosrv-engine") as lab:
        yield lab.host("machine", "10.79.0.1/24")


@pytest.fixture(scope="module")
def demo(machine: Host, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Compose]:
    with Engine(machine) as engine:
        compose = engine.compose(project(tmp_path_factory.mktemp("project")), "smoke")
        compose("--profile", "demo", "up", "--detach", "--no-build")
        yield compose
        compose("--profile", "demo", "down", "--volumes", "--timeout", "5")


@pytest.fixture(scope="module")
def rest(machine: Host, demo: Compose, tmp_path_factory: pytest.TempPathFactory) -> Rest:
    token = demo.exec("appliance", "cat", "/var/lib/rosrv/first-token").stdout.strip()
    certificate = tmp_path_factory.mktemp("rest") / "certificate.pem"
    address = ("127.0.0.1", 8443)
    certificate.write_text(machine.run(lambda: ssl.get_server_certificate(address, timeout=30)))
    client = Rest("https://127.0.0.1:8443", token, certificate)
    # Nodes may connect before the api has read its tokens; until then it answers 503.
    eventually(lambda: machine.run(lambda: client.get("/v1/status")).status == 200, demo.story)
    return client


def test_messages_pass_and_a_visitor_is_denied(demo: Compose) -> None:
    demo.wait_for_log("ocu", '"position"', timeout=240)
    denied = eventually(lambda: demo.audit("--deny", "--host", TABLET), demo.story)
    assert {one["rule"]["file"] for one in denied if one["rule"]} == {"/etc/rosrv/policies/containers.ini"}
    demo.exec("appliance", "rosrv", "audit", "verify")  # fails if a record is missing or changed


def test_a_policy_is_reloaded_over_rest(machine: Host, demo: Compose, rest: Rest) -> None:
    before = machine.run(lambda: rest.get("/v1/policy")).json
    policy: Path = demo.directory / "policies" / "containers.ini"
    policy.write_text(policy.read_text() + "\n# edited by its operator\n")
    answer = machine.run(lambda: rest.post("/v1/policy/reload", match="*"))
    assert answer.status == 200, answer.body
    after = machine.run(lambda: rest.get("/v1/policy")).json
    assert after["revision"] > before["revision"]
    assert after["text"].endswith("# edited by its operator\n")
    assert eventually(lambda: len(demo.audit("--event", "policy loaded")) > 1, demo.story)
