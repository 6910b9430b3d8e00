"""A client generated from the contract, as by an integrator, calls every operation and parses every answer.

The generator's dependencies are separate (`generated-client.lock`). Bodies are the contract's examples.
"""

import base64
import contextlib
import json
import subprocess
import sys
import xmlrpc.client
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from appliance.api.routes.contract import EXAMPLES
from appliance.ipsec.requests import make_key, signing_request
from examples.landshark.lab import Host, Lab
from tests.support.nodes import RosSession, need_ros
from tests.support.requirements import need_root
from tests.support.rest import Rest
from tests.support.tunnel_site import API, MASTER, MIDDLE, OWN, POLICY, ROBOT, TunnelSite
from tests.support.tunnels import need_strongswan

LOCK = Path(__file__).with_name("generated-client.lock")
UV = Path(sys.executable).with_name("uv")
# settings of the page for the generator: parsing answers that are not JSON
ROOT = Path(__file__).parents[2]
CONFIGURATION = ROOT / "examples/openapi/openapi-python-client.yaml"
CONFIG = f"""\
api: 0.0.0.0:{API}
api_networks: [10.88.0.0/24]
api_names: [{MIDDLE}, {OWN}]
recorder: {{enabled: true, memory: 16MiB, disk: 512MiB, triggers: []}}
"""
NAME = EXAMPLES["NewHost"]["name"]
# One call of the generated client per line: the parsed answer and the raw answer; for a stream, its first event.
DRIVER = """
import base64, enum, importlib, json, pkgutil, sys, typing
folder, url, certificate = sys.argv[1:]
sys.path.insert(0, folder)
import httpx, client.api, client.models
from client import AuthenticatedClient
from client.types import File
found = [one for one in pkgutil.walk_packages(client.api.__path__, "client.api.") if not one.ispkg]
operations = {one.name.rpartition(".")[2]: importlib.import_module(one.name) for one in found}
for line in sys.stdin:
    token, name, arguments, body, stream = json.loads(line)
    asking = AuthenticatedClient(base_url=url, token=token, verify_ssl=certificate, raise_on_unexpected_status=True)
    operation = operations[name]
    for field, kind in typing.get_type_hints(operation._get_kwargs).items():
        if field in arguments and isinstance(kind, type) and issubclass(kind, enum.Enum):
            arguments[field] = kind(arguments[field])
    if body is not None:
        arguments["body"] = getattr(client.models, body[0]).from_dict(body[1])
    if stream:
        with asking.get_httpx_client().stream(**operation._get_kwargs(**arguments)) as following:
            text = ""
            for part in following.iter_text():
                text += part
                if "data:" in text and text.replace("\\r", "").endswith("\\n\\n"):
                    break
            answer = operation._build_response(client=asking, response=httpx.Response(following.status_code, text=text))
    else:
        answer = operation.sync_detailed(client=asking, **arguments)
    made = answer.parsed
    kind = type(made).__name__
    if isinstance(made, File):
        made = base64.b64encode(made.payload.read()).decode()
    elif hasattr(made, "to_dict"):
        made = made.to_dict()
    json_said = "json" in answer.headers.get("content-type", "")
    said = json.loads(answer.content) if json_said else None
    print(json.dumps([int(answer.status_code), kind, made, said]), flush=True)
"""
Done = dict[str, Any]  # operation -> type of its parsed answer


@dataclass(frozen=True)
class Call:
    """A call whose arguments and body depend on earlier answers. An `inside` call goes through a host's tunnel."""

    arguments: Callable[[Done], dict[str, Any]] = lambda _done: {}
    body: Callable[[Done], dict[str, Any]] = lambda _done: {}
    inside: bool = False


def of(**arguments: Any) -> Call:
    return Call(lambda _done: arguments)


def refusal(done: Done) -> dict[str, Any]:
    return {"record_id": str(done["search_audit"]["records"][0]["sequence"])}


def saved(done: Done) -> dict[str, Any]:
    return {"recording_id": done["recording_of_memory"]["id"]}


def renewal(done: Done) -> dict[str, Any]:
    asked = signing_request(make_key(), NAME)
    present = load_pem_private_key(done["key"], password=None)
    assert isinstance(present, ec.EllipticCurvePrivateKey)
    proof = present.sign(asked, ec.ECDSA(hashes.SHA384()))
    return {"request": asked.decode(), "proof": base64.b64encode(proof).decode()}


def reached(_done: Done) -> dict[str, Any]:
    return {"endpoint": MIDDLE}


# In this order. A monitor and its talker exist, and a host's publication was denied.
CALLS = {
    "live": of(), "ready": of(), "live_v1": of(), "ready_v1": of(), "status": of(), "inventory": of(), "metrics": of(),
    "metrics_v1": of(), "history": of(points=2), "whoami": of(), "challenge": of(), "live_state": of(graph=False),
    "graph": of(), "topic_messages": of(topic="/odom", messages=1, seconds=10.0), "tokens": of(),
    "alarms": of(), "limits": of(), "host_names": of(),
    "guards": of(), "guard_suggestions": of(), "driver_check": of(), "doors": of(), "own_door": of(),
    "drive": of(), "approvals": of(), "sso_sessions": of(),
    "revoke_token": of(name="shift"),
    "record_now": of(),
    "recording_of_memory": Call(body=lambda _done: {"since": 0}),
    "recordings": of(), "recording": Call(saved), "recording_timeline": Call(saved),
    "recording_messages": Call(lambda done: saved(done) | {"at": done["recording_of_memory"]["ended_utc"]}),
    "recording_bag": Call(saved), "recording_evidence": Call(saved),
    "monitors": of(), "monitor": of(name="censor"), "monitor_history": of(name="censor"),
    "monitor_picture": of(name="censor"), "set_monitor": of(name="censor"),
    "load_monitors": of(confirm_within=300), "confirm_monitors": of(),
    "monitor_values": of(name="censor"),
    "monitor_revisions": of(), "monitor_revision": of(revision=2), "switch_monitor": of(name="censor"),
    "switch_monitors": of(), "replace_monitor": of(name="censor"), "remove_monitor": of(name="censor"),
    "roll_back_monitors": of(), "remove_monitors": of(name=["censor"]), "reload_monitors": of(),
    "search_audit": of(deny=True, topic="/cmd_vel"), "audit_record": Call(refusal), "why_of_record": Call(refusal),
    "grant_of_record": Call(refusal), "verify_audit": of(), "audit_checkpoints": of(), "export_audit": of(deny=True),
    "export_evidence": Call(lambda done: {"since": done["search_audit"]["records"][0]["time"]}),
    "follow_audit": of(after=0), "summarise_audit": of(),
    "policy": of(), "policy_revisions": of(), "policy_revision": of(revision=1),
    "explain": of(host=ROBOT, category="publish", resource="/cmd_vel", node="/joy"), "explain_under": of(),
    "test_policy": of(), "policy_uses": of(),
    "load_policy": of(confirm_within=300), "confirm_policy": of(), "roll_back_policy": of(), "reload_policy": of(),
    "hosts": of(), "enrol_host": Call(body=reached), "host": of(name=NAME),
    "host_token": Call(lambda _done: {"name": NAME}, reached),
    "enrol": Call(body=lambda done: {
        "token": done["host_token"]["token"], "request": signing_request(make_key(), NAME).decode(),
    }),
    "host_kit": of(name=NAME, endpoint=MIDDLE), "new_host_kit": Call(lambda _done: {"name": NAME}, reached),
    "tell_host_ports": of(name=NAME), "reload_hosts": of(), "authority": of(), "revocations": of(),
    "renew_host": Call(lambda _done: {"name": NAME}, renewal, inside=True),
    "host_renewed": Call(lambda _done: {"name": NAME}, inside=True),
    "revoke_host": of(name=NAME), "block_host": of(), "host_blocks": of(), "unblock_host": of(address="192.0.2.66"),
    "remove_recording": Call(lambda done: {"recording_id": done["record_now"]["id"]}),
}  # fmt: skip
REFUSED: dict[str, dict[str, Any]] = {
    "standby": {}, "switch_standby": {}, "acknowledge_alarm": {}, "silence_alarm": {},
    "drive_assign": {"group": "base"}, "drive_free": {"group": "base"}, "drive_ask": {"group": "base"},
    "remove_door": {"door_name": "alice"}, "make_door_ticket": {"door_name": "alice"},
    "make_own_ticket": {}, "plan_guard": {}, "approve": {"number": 48213}, "approval_refuse": {"number": 48213},
    "end_sessions": {"name": "alice"}, "sign_out": {"session": "0" * 12},
}  # fmt: skip

ELSEWHERE = {
    "begin_sign_on",
    "complete_sign_on",
    "new_guard",
    "set_guard",
    "upgrade_guard",
    "check_driver",
    "test_guard",
    "add_door",
}
"""Operations that need a provider, a guard's topics or a door. The tests of these features call them."""

FOR_INVESTIGATORS = {"recording_of_memory", "recording_messages", "recording_bag", "recording_evidence"}


@pytest.fixture
def generator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("generator") / "venv"
    for command in (["venv", str(place)], ["pip", "sync", "--python", str(place / "bin/python"), str(LOCK)]):
        subprocess.run([UV, "--quiet", *command], check=True, timeout=240)
    return place / "bin"


@pytest.fixture
def site(tmp_path: Path) -> Iterator[TunnelSite]:
    need_root()
    need_strongswan()
    need_ros()
    (tmp_path / "appliance.yaml").write_text(CONFIG)
    with Lab("rosrv-client") as lab:
        policy = POLICY.replace("[Publishers]\n", "[Publishers]\n/cmd_vel = 192.0.2.10\n")
        options = ("--config", str(tmp_path / "appliance.yaml"))
        site = TunnelSite(lab, tmp_path, policy=policy, options=options)
        folder = site.appliance.directory / "monitors"
        folder.mkdir()
        (folder / "censor.rv").write_text(EXAMPLES["Monitor"]["text"])
        site.appliance.options += ("--monitors", str(folder))
        with site, RosSession(MASTER, tmp_path, site.robot) as ros:
            site.appliance.rosrv("token", "add", "shift", "--role", "operator")
            ros.listener("rospy", "/rude", name="ear")
            ros.talker("rospy", "/rude", "--rate", "10", name="voice")
            ros.talker("roscpp", "/odom", "--rate", "10", name="odometer")
            assert site.robot.run(register)[0] != 1
            yield site


def register() -> Any:
    with xmlrpc.client.ServerProxy(MASTER) as master:
        return master.registerPublisher("/joy", "/cmd_vel", "geometry_msgs/Twist", f"http://{ROBOT}:1/")


class Client:
    def __init__(self, program: Path, folder: Path, rest: Rest, host: Host, address: str) -> None:
        url = f"https://{address}:{rest.url.port}"
        command = [str(program), "-c", DRIVER, str(folder), url, str(rest.certificate)]
        self._process = host.popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def ask(self, *call: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(call) + "\n")
            self._process.stdin.flush()
        if line := self._process.stdout.readline():
            return json.loads(line)
        raise AssertionError(f"{call[1]}: {self._process.communicate()[1]}")

    def close(self) -> None:
        self._process.communicate()


def generate(generator: Path, contract: Any, folder: Path) -> None:
    (folder / "openapi.json").write_text(json.dumps(contract))
    made = subprocess.run(
        [generator / "openapi-python-client", "generate", "--path", "openapi.json", "--output-path", "client",
         "--meta", "none", "--config", CONFIGURATION],
        cwd=folder, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    assert "Unable to parse" not in made.stdout
    assert "omitted" not in made.stdout, made.stdout


def same(read: Any, said: Any) -> bool:
    if isinstance(read, dict) and isinstance(said, dict):
        return read.keys() == said.keys() and all(same(read[name], said[name]) for name in said)
    if isinstance(read, list) and isinstance(said, list):
        return len(read) == len(said) and all(map(same, read, said))
    if isinstance(read, str) and isinstance(said, str) and said.endswith("Z"):
        return read == said or read[:19] == said[:19]
    return bool(read == said)


def test_every_operation_is_called_and_its_answer_parsed(
    generator: Path, site: TunnelSite, tmp_path: Path
) -> None:
    rest = site.rest()
    contract = site.attacker.run(lambda: rest.get("/v1/openapi.json")).json
    assert not [name for name in contract["components"]["schemas"] if "." in name], "no module's name leaks"
    operations = {one["operationId"]: one for path in contract["paths"].values() for one in path.values()}
    generate(generator, contract, tmp_path)
    added = site.appliance.rosrv("token", "add", "eve", "--role", "investigator", "--json").stdout
    investigator = str(json.loads(added)["token"])
    done: Done = {}
    with contextlib.ExitStack() as closing:
        client = Client(generator / "python", tmp_path, rest, site.attacker, MIDDLE)
        closing.callback(client.close)
        tunnel: Client | None = None
        for name, call in CALLS.items():
            if call.inside and tunnel is None:
                joined = closing.enter_context(site.joined(kit_of(done, tmp_path)))
                done["key"] = next((joined.folder / "swanctl/private").iterdir()).read_bytes()
                tunnel = Client(generator / "python", tmp_path, rest, site.ocu, OWN)
                closing.callback(tunnel.close)
            asking = tunnel if call.inside and tunnel is not None else client
            if name == "remove_recording":
                site.recorded(0, event="recording closed")
            token = investigator if name in FOR_INVESTIGATORS else site.appliance.token
            done[name] = asked(asking, token, operations[name], call, done)
        for name, arguments in REFUSED.items():
            assert "404" in operations[name]["responses"]
            body = body_of(operations[name], {})
            assert client.ask(site.appliance.token, name, arguments, body, False)[0] == 404, name


def kit_of(done: Done, folder: Path) -> Path:
    kit = folder / "kit.tar.gz"
    kit.write_bytes(base64.b64decode(done["new_host_kit"]))
    return kit


def asked(client: Client, token: str, operation: dict[str, Any], call: Call, done: Done) -> Any:
    arguments = call.arguments(done)
    if any(one["name"] == "If-Match" for one in operation.get("parameters", ())):
        arguments = arguments | {"if_match": "*"}
    body = body_of(operation, call.body(done))
    status, promised = next(
        (int(status), row.get("content", {}))
        for status, row in operation["responses"].items()
        if status < "300"
    )
    name = operation["operationId"]
    given, kind, read, said = client.ask(token, name, arguments, body, "text/event-stream" in promised)
    assert given == status, (name, given, read)
    expected = {"application/octet-stream": "File", "application/gzip": "File", "application/zip": "File"}
    first = next(iter(promised), None)
    if first is None:
        assert kind == "NoneType", (name, kind)
    elif first != "application/json":
        assert (kind, bool(read)) == (expected.get(first, "str"), True), (name, kind)
    else:
        assert kind_of(promised[first]) in (kind, ""), (name, kind)
        assert same(read, said), (name, read, said)
    return read


def body_of(operation: dict[str, Any], changes: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    if "requestBody" not in operation:
        return None
    kind = kind_of(operation["requestBody"]["content"]["application/json"])
    return kind, EXAMPLES[kind] | changes


def kind_of(content: dict[str, Any]) -> str:
    return str(content["schema"].get("$ref", "")).rpartition("/")[2]
