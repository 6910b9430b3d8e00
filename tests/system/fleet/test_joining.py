import contextlib
import hashlib
import json
import os
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import httpx
import pytest
from rosrv_fleet.invitations import Invitations

from appliance.configuration.config_sources import resolve
from appliance.features.fleet.connection import robot_connection
from appliance.features.fleet.segment_process import SegmentPusher
from appliance.features.fleet.settings import Fleet
from appliance.formats.fleet_membership import JOIN_PATH
from appliance.signing.own_certificate import make_own_certificate
from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from tests.support.command import rosrv
from tests.support.sources import ROOT
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]
USED = "the invitation is wrong, already used or expired"


@pytest.fixture
def inviting(site: FleetSite) -> FleetSite:
    site.server.certificate.write_bytes(site.server.certificate.read_bytes() + site.server.ca.read_bytes())
    return site


def invite(site: FleetSite, name: str, file: Path, *options: str) -> Path:
    file.write_text(site.run("robot", "invite", name, *options).stdout)
    return file


def state_of(robot: FleetRobot) -> Path:
    control = robot.folder / "appliance" / "control"
    control.mkdir(parents=True, exist_ok=True)
    shutil.copy(robot.folder / "audit.pub.pem", control / "audit.pub")
    return control.parent


def join(robot: FleetRobot, file: Path, status: int = 0) -> str:
    done = rosrv("fleet", "join", str(file), "--state", str(state_of(robot)))
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def pusher_of(robot: FleetRobot) -> SegmentPusher:
    fleet = resolve(None, {}, {"state": state_of(robot), "isolation": "none"}).of(Fleet)
    link = robot_connection(*fleet.connection)
    return SegmentPusher(robot.log_file, robot.folder / "state", link, robot.site.receipt_key)


def pushes_all(robot: FleetRobot) -> bool:
    pusher = pusher_of(robot)
    while pusher.step() == 0:
        pass
    pusher.close()
    return not pusher.progress.trouble


def request_of(robot: FleetRobot, file: Path) -> dict[str, str]:
    certificate = make_own_certificate(robot.name, 1)[1].decode()
    key = (robot.folder / "audit.pub.pem").read_text()
    return {"token": json.loads(file.read_text())["token"], "key": key, "certificate": certificate}


def post(site: FleetSite, request: dict[str, str]) -> httpx.Response:
    with site.client() as client:
        return client.post("/v1/join", json=request)


def test_a_robot_joins_and_pushes(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot = make_robot("arm7", enrolled=False)
    assert (
        "is not SITE/GROUP" in inviting.run("robot", "invite", "arm7", "--group", "site-a", status=2).stderr
    )
    said = join(robot, invite(inviting, "arm7", tmp_path / "arm7.json", "--group", "site-a/arms"))
    bundles = resolve(None, {}, {"state": state_of(robot), "isolation": "none"}).of(Fleet).bundles
    assert (bundles.site, bundles.group) == ("site-a", "arms")
    (listed,) = map(json.loads, inviting.run("robot", "list", "--json").stdout.splitlines())
    assert (listed["name"], listed["group"]) == ("arm7", "site-a/arms")
    assert listed["certificate"] in said
    robot.record(30)

    eventually(partial(pushes_all, robot), "the running collector notices the robot")
    (proof,) = map(json.loads, inviting.run("verify", "--json").stdout.splitlines())
    assert (proof["ok"], proof["robot"], proof["last"]) == (True, "arm7", robot.sealed())
    key = state_of(robot) / "joined" / "robot.key"
    found = key.stat()
    assert found.st_mode & 0o777 == 0o640
    if os.geteuid() == 0:
        assert (found.st_uid, found.st_gid) == (61023, 61022)
    assert inviting.data is not None
    inviting.indexed()
    inviting.stop()  # then no file comes or goes
    kept = b"".join(one.read_bytes() for one in inviting.data.rglob("*") if one.is_file())
    assert b"arm7" in kept
    assert key.read_text().splitlines()[1].encode() not in kept
    assert json.loads((tmp_path / "arm7.json").read_text())["token"].encode() not in kept


def test_an_invitation_is_valid_once(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    first, second = make_robot("arm1", enrolled=False), make_robot("arm2", enrolled=False)
    used = invite(inviting, "arm1", tmp_path / "used.json")
    join(first, used)
    expired = invite(inviting, "arm2", tmp_path / "expired.json")
    replaced = invite(inviting, "arm3", tmp_path / "replaced.json")
    assert inviting.data is not None
    Invitations(inviting.data / "invitations").add("arm2", "", -1.0)
    invite(inviting, "arm3", tmp_path / "newer.json")
    wrong = [request_of(second, file) for file in (used, expired, replaced)]
    wrong.append(wrong[0] | {"token": f"rosrv-join_{'A' * 43}"})
    answers = {(answer.status_code, answer.text) for answer in (post(inviting, one) for one in wrong)}
    assert len(answers) == 1
    assert answers.pop()[0] == 403
    assert USED in join(second, used, status=1)
    assert not (state_of(second) / "joined").exists()
    assert [line.split()[0] for line in inviting.run("robot", "list").stdout.splitlines()] == ["arm1"]


def test_an_expired_invitation_is_refused(inviting: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1", enrolled=False)
    assert inviting.data is not None
    _pending, token = Invitations(inviting.data / "invitations").add("arm1", "", -1.0)
    request = {"token": token, "key": (robot.folder / "audit.pub.pem").read_text()}
    answer = post(inviting, request | {"certificate": make_own_certificate("arm1", 1)[1].decode()})
    assert (answer.status_code, USED in answer.text) == (403, True)


def test_one_of_two_wins(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot = make_robot("arm1", enrolled=False)
    file = invite(inviting, "arm1", tmp_path / "arm1.json")
    requests = [request_of(robot, file) for _ in range(20)]
    begin, answers = threading.Barrier(len(requests)), list[int]()

    def send(request: dict[str, str]) -> None:
        begin.wait()
        answers.append(post(inviting, request).status_code)

    threads = [threading.Thread(target=send, args=(request,)) for request in requests]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [201, *[403] * 19]


def test_twenty_repetitions_are_one_join(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot = make_robot("arm1", enrolled=False)
    request = request_of(robot, invite(inviting, "arm1", tmp_path / "arm1.json"))
    begin = threading.Barrier(20)

    def send(_number: int) -> tuple[int, str]:
        begin.wait(60)
        answer = post(inviting, request)
        return answer.status_code, answer.text

    with ThreadPoolExecutor(20) as pool:
        assert set(pool.map(send, range(20))) == {(201, '{"robot":"arm1"}')}
    assert _joins(inviting) == ["asked", "done"]


def _joins(site: FleetSite) -> list[str]:
    assert site.data is not None
    acts = map(json.loads, (site.data / "acts.ndjson").read_text().splitlines())
    return [act["result"] for act in acts if act["act"] == "robot join"]


@contextlib.contextmanager
def without_answers(port: int, answered: Callable[[], bool]) -> Iterator[int]:
    """Forward a connection to a port of the loopback, without its answers after the TLS handshake.

    Before `answered`, the dropped bytes are TLS tickets; the first bytes after it end the connection.
    """
    listener = socket.create_server(("127.0.0.1", 0))

    def forward() -> None:
        client, _address = listener.accept()
        with client, socket.create_connection(("127.0.0.1", port)) as server:
            handshake = threading.Event()

            def back() -> None:
                while part := server.recv(65_536):
                    if not handshake.is_set():
                        client.sendall(part)
                    elif answered():
                        break
                client.shutdown(socket.SHUT_RDWR)

            answering = threading.Thread(target=back)
            answering.start()
            server.sendall(client.recv(65_536))  # the client's hello
            while part := client.recv(65_536):
                handshake.set()
                server.sendall(part)
            with contextlib.suppress(OSError):
                server.shutdown(socket.SHUT_RDWR)
            answering.join()

    thread = threading.Thread(target=forward)
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        thread.join()
        listener.close()


def test_a_lost_answer_needs_no_new_invitation(
    inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot, other = make_robot("arm1", enrolled=False), make_robot("arm2", enrolled=False)
    file = invite(inviting, "arm1", tmp_path / "arm1.json")

    def enrolled() -> bool:
        return _joins(inviting) == ["asked", "done"]

    with without_answers(inviting.port, enrolled) as port:
        (tmp_path / "lossy.json").write_text(file.read_text().replace(f":{inviting.port}", f":{port}"))
        assert "run the command again with the same invitation" in join(
            robot, tmp_path / "lossy.json", status=1
        )
    assert enrolled()
    assert not (state_of(robot) / "joined").exists()
    assert USED in join(other, file, status=1)
    said = join(robot, file)
    (listed,) = map(json.loads, inviting.run("robot", "list", "--json").stdout.splitlines())
    assert listed["certificate"] in said
    assert enrolled()
    assert sorted(one.name for one in state_of(robot).glob("joined*/*")) == [
        "collector.pem", "fleet.json", "receipts.pub", "robot.key", "robot.pem"
    ]  # fmt: skip
    robot.record(10)

    eventually(partial(pushes_all, robot), "the robot pushes with the key that it kept")


def test_a_repeated_join_undoes_nothing(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot = make_robot("arm1", enrolled=False)
    request = request_of(robot, invite(inviting, "arm1", tmp_path / "arm1.json"))
    assert post(inviting, request).status_code == 201
    inviting.run("robot", "renew", "arm1", "--certificate", str(robot.certificates.certificate))
    assert (post(inviting, request).status_code, USED in post(inviting, request).text) == (403, True)
    (listed,) = map(json.loads, inviting.run("robot", "list", "--json").stdout.splitlines())
    assert listed["certificate"] == _fingerprint(robot.certificates.certificate.read_text())


@pytest.mark.parametrize("body", [b"", b"{}", b'{"token":"\xff"}'], ids=["empty", "no fields", "no UTF-8"])
def test_a_malformed_request_is_refused(body: bytes, inviting: FleetSite) -> None:
    with inviting.client() as client:
        answer = client.post(JOIN_PATH, content=body)
    assert answer.status_code == 422
    assert "not a request to join" in answer.json()["detail"]


def test_guessing_has_to_wait(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    request = request_of(make_robot("arm1", enrolled=False), invite(inviting, "arm1", tmp_path / "arm1.json"))
    wrong = [request | {"token": f"rosrv-join_{number:043d}"} for number in range(31)]
    assert [post(inviting, one).status_code for one in wrong] == [*[403] * 30, 429]


def test_a_second_join_renews(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot, other = make_robot("arm1", enrolled=False), make_robot("other", enrolled=False)
    join(robot, invite(inviting, "arm1", tmp_path / "first.json"))
    earlier = (state_of(robot) / "joined" / "robot.pem").read_text()
    second = invite(inviting, "arm1", tmp_path / "second.json")
    assert "enrolled with another log key" in join(other, second, status=1)
    join(robot, second)
    (listed,) = map(json.loads, inviting.run("robot", "list", "--json").stdout.splitlines())
    now = (state_of(robot) / "joined" / "robot.pem").read_text()
    assert now != earlier
    assert listed["certificate"] == _fingerprint(now)
    assert rosrv("fleet", "leave", "--state", str(state_of(robot))).returncode == 0
    assert resolve(None, {}, {"state": state_of(robot), "isolation": "none"}).of(Fleet).collector is None


def test_a_certificate_without_its_key_is_refused(
    inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1", enrolled=False)
    request = request_of(robot, invite(inviting, "arm1", tmp_path / "arm1.json"))
    foreign = robot.certificates.certificate.read_text()
    answer = post(inviting, request | {"certificate": foreign})
    assert (answer.status_code, "not signed with its own key" in answer.text) == (409, True)
    assert post(inviting, request).status_code == 201


def test_a_robot_asks_only_its_collector(inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    robot = make_robot("arm1", enrolled=False)
    invitation = json.loads(invite(inviting, "arm1", tmp_path / "arm1.json").read_text())
    invitation["authority"] = make_own_certificate("rosrv-fleet", 1, "127.0.0.1")[1].decode()
    (tmp_path / "other.json").write_text(json.dumps(invitation))
    assert "certificate verify failed" in join(robot, tmp_path / "other.json", status=1)
    assert not (state_of(robot) / "joined").exists()
    join(robot, tmp_path / "arm1.json")


def test_health_shows_when_certificates_end(
    inviting: FleetSite, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1", enrolled=False)
    join(robot, invite(inviting, "arm1", tmp_path / "arm1.json"))
    (state,) = inviting.health()["robots"]
    assert 824 < state["certificate_seconds"] / 86_400 <= 825
    assert 'rosrv_fleet_certificate_seconds{robot="arm1"} 7' in inviting.get("/metrics").text
    cookie = {"Cookie": f"__Host-rosrv-fleet={inviting.token}"}

    def marked() -> bool:
        with inviting.client() as client:
            return "robot=arm1" in client.get("/", headers=cookie, params={"state": "certificate ends"}).text

    assert not marked()
    second = request_of(robot, invite(inviting, "arm1", tmp_path / "second.json"))  # for a day
    assert post(inviting, second).status_code == 201
    assert marked()


def _fingerprint(pem: str) -> str:
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(pem)).hexdigest()


def test_the_health_check_asks_this_collector_only(inviting: FleetSite, tmp_path: Path) -> None:
    environment = {
        "PYTHONPATH": str(ROOT / "fleet" / "src"),
        "ROSRV_FLEET_CONFIG": str(inviting.folder / "fleet.yaml"),
    }

    def checked() -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "-m", "rosrv_fleet.healthy"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stderr

    assert checked() == (0, "")
    key, certificate = make_own_certificate("other", 1, "127.0.0.1")
    (tmp_path / "own.pem").write_bytes(certificate)
    (tmp_path / "own.key").write_bytes(key)
    inviting.write_config(certificate=str(tmp_path / "own.pem"), key=str(tmp_path / "own.key"))
    status, said = checked()
    assert status == 1
    assert "certificate verify failed" in said
    inviting.write_config()
    inviting.kill()
    assert checked()[0] == 1
