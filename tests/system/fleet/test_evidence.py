import json
import secrets
import shutil
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from rosrv_fleet.access import COOKIE

from appliance.formats import bundle_verifier
from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually
from tests.system.fleet.incidents import incident
from tests.system.fleet.test_bundles import Operator
from tests.unit.features.evidence.test_bundle import Members, members_of, written

MakeRobot = Callable[..., FleetRobot]


class Carrier:
    def __init__(self, site: FleetSite) -> None:
        self.site = site
        self.token = site.run("token", "add", "olga", "--role", "operator").stdout.strip()

    def add(self, bundle: bytes, robot: str = "arm1", token: str = "") -> httpx.Response:
        with self.site.client() as client:
            headers = {"Authorization": f"Bearer {token or self.token}"}
            return client.post("/v1/evidence", params={"robot": robot}, content=bundle, headers=headers)

    def stored(self) -> list[dict[str, Any]]:
        assert list(self.incoming.iterdir()) == []
        return list(self.site.get("/v1/evidence").json())

    @property
    def incoming(self) -> Path:
        assert self.site.data is not None
        return self.site.data / "evidence" / "incoming"


def acts_of(site: FleetSite) -> list[tuple[str, str, str]]:
    assert site.data is not None
    acts = map(json.loads, (site.data / "acts.ndjson").read_text().splitlines())
    return [
        (act["who"], act["act"], act["about"])
        for act in acts
        if "evidence" in act["act"] and act["result"] == "done"
    ]


@pytest.fixture
def carrier(site: FleetSite) -> Carrier:
    return Carrier(site)


def test_a_bundle_is_added_listed_and_returned(
    site: FleetSite, make_robot: MakeRobot, tmp_path: Path
) -> None:
    operator, robot = Operator(site, tmp_path / "operator"), make_robot("arm1")
    bundle = incident(robot, tmp_path / "incident.zip", secrets.token_bytes(500_000))
    robot.push()
    added = operator.remote("evidence", "add", str(bundle), "--robot", "arm1")
    name = added.split()[0]
    assert "is stored: evidence of arm1" in added
    assert "recording abababababababababab" in added
    listed = operator.remote("evidence", "list", "--robot", "arm1", "--json", token=operator.viewer)
    about = json.loads(listed)
    assert (about["id"], about["by"], about["bytes"]) == (name, "olga", bundle.stat().st_size)
    assert about["collected"] == about["checkpoints"] > 1
    assert "was stored before; nothing has changed" in operator.remote(
        "evidence", "add", str(bundle), "--robot", "arm1"
    )
    assert operator.remote("evidence", "list", "--json") == listed
    assert "added by olga" in operator.remote("evidence", "list")
    assert not operator.remote("evidence", "list", "--robot", "arm2")
    copy = tmp_path / "copy.zip"
    operator.remote("evidence", "get", name, "--output", str(copy))
    assert copy.read_bytes() == bundle.read_bytes()
    assert bundle_verifier.main([str(copy), "--key", str(robot.folder / "audit.pub.pem")]) == 0
    assert "File exists" in operator.remote("evidence", "get", name, "--output", str(copy), status=2)
    assert "no evidence bundle" in operator.remote(
        "evidence", "get", "0" * 64, "--output", str(tmp_path / "none"), status=1
    )
    assert not list(tmp_path.glob("none*"))
    assert acts_of(site) == [("olga", "evidence add", "arm1"), ("olga", "evidence get", "arm1")]


def test_removed_evidence_makes_room(site: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    """A command on the collector's machine removes a bundle while the collector runs, and it can be added again."""
    operator, robot = Operator(site, tmp_path / "operator"), make_robot("arm1")
    bundle = incident(robot, tmp_path / "incident.zip")
    name = operator.remote("evidence", "add", str(bundle), "--robot", "arm1").split()[0]
    for wrong in ("0" * 64, f"../evidence/{name}", "incoming"):
        assert "no evidence bundle has this ID" in site.run("evidence", "remove", wrong, status=2).stderr
    assert f"{name} is removed: evidence of arm1" in site.run("evidence", "remove", name).stdout
    assert not operator.remote("evidence", "list")
    assert "no evidence bundle" in operator.remote(
        "evidence", "get", name, "--output", str(tmp_path / "none"), status=1
    )
    assert site.data is not None
    assert [path.name for path in (site.data / "evidence").iterdir()] == ["incoming"]
    assert not list((site.data / "evidence" / "incoming").iterdir())
    assert "is stored" in operator.remote("evidence", "add", str(bundle), "--robot", "arm1")
    assert [act for _who, act, _about in acts_of(site)] == ["evidence add", "evidence remove", "evidence add"]


def test_the_console_links_records_to_their_bundle(
    site: FleetSite, carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1")
    bundle = incident(robot, tmp_path / "incident.zip")
    robot.record(3, reason="after the bundle")
    robot.push()
    site.indexed()
    name = carrier.add(bundle.read_bytes()).json()["id"]

    def page(path: str, token: str) -> str:
        with site.client() as client:
            return client.get(path, headers={"Cookie": f"{COOKIE}={token}"}).text

    assert f'href="/evidence?id={name}"' in page("/search?event=decision", site.token)
    assert "/evidence?id=" not in page("/search?text=after+the+bundle", site.token)
    for token, content in ((site.token, False), (carrier.token, True)):
        shown = page(f"/evidence?id={name}", token)
        assert name[:12] in shown
        assert (f'href="/v1/evidence/{name}"' in shown) is content
    assert name[:12] not in page("/evidence?robot=arm2", site.token)


def test_viewers_and_robots_neither_add_nor_get(
    site: FleetSite, carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1")
    bundle = incident(robot, tmp_path / "incident.zip").read_bytes()
    assert carrier.add(bundle, token=site.token).status_code == 403
    with site.client(robot.certificates) as client:
        assert client.post("/v1/evidence", params={"robot": "arm1"}, content=bundle).status_code == 401
    name = carrier.add(bundle).json()["id"]
    assert site.get(f"/v1/evidence/{name}").status_code == 403
    assert site.get("/v1/evidence", token=None).status_code == 401
    assert acts_of(carrier.site) == [("olga", "evidence add", "arm1")]


def _without_a_record(members: Members) -> None:
    lines = members["records.ndjson"].splitlines(keepends=True)
    members["records.ndjson"] = b"".join(lines[:5] + lines[6:])


def _with_another_policy(members: Members) -> None:
    members["policies/7.ini"] += b"other = *\n"


def _with_a_stranger(members: Members) -> None:
    members["stranger.txt"] = b"?"


def _with_a_changed_proof(members: Members) -> None:
    members["proof.json"] = members["proof.json"].replace(b'"manifest', b'"manifesT')


def _without_a_key(members: Members) -> None:
    del members["audit.pub"]


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (_without_a_record, "'records.ndjson': was changed"),
        (_with_another_policy, "policies/7.ini: does not match the hash in the log"),
        (_with_a_stranger, "'stranger.txt': does not belong to the bundle"),
        (_with_a_changed_proof, "proof.json"),
        (_without_a_key, "audit.pub"),
    ],
)
def test_a_changed_bundle_is_refused(
    carrier: Carrier,
    make_robot: MakeRobot,
    tmp_path: Path,
    change: Callable[[Members], None],
    finding: str,
) -> None:
    members = members_of(incident(make_robot("arm1"), tmp_path / "incident.zip"))
    change(members)
    answer = carrier.add(written(members, tmp_path / "changed.zip").read_bytes())
    assert answer.status_code == 422
    assert "not valid evidence of arm1" in answer.json()["detail"]
    assert finding in answer.json()["detail"]
    assert carrier.stored() == []
    assert acts_of(carrier.site) == []


def test_changed_bytes_and_other_files_are_refused(
    carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    bundle = incident(make_robot("arm1"), tmp_path / "incident.zip").read_bytes()
    middle = len(bundle) // 2
    flipped = bundle[:middle] + bytes([bundle[middle] ^ 1]) + bundle[middle + 1 :]
    for wrong in (bundle + b"?", b"?" + bundle, bundle[:-100], flipped, b"", b"no bundle" * 100):
        answer = carrier.add(wrong)
        assert (answer.status_code, answer.json()["detail"][:26]) == (422, "not valid evidence of arm1")
    assert carrier.stored() == []
    assert carrier.add(bundle).status_code == 201


def test_a_bundle_of_another_robot_is_refused(
    site: FleetSite, carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot, _other = make_robot("arm1"), make_robot("arm2")
    bundle = incident(robot, tmp_path / "incident.zip").read_bytes()
    answer = carrier.add(bundle, "arm2")
    assert answer.status_code == 422
    assert "the bundle that of arm1; use --robot arm1" in answer.json()["detail"]
    unknown = FleetRobot(site, "stranger", enrolled=False)
    answer = carrier.add(incident(unknown, tmp_path / "unknown.zip").read_bytes(), "arm2")
    unknown.close()
    assert answer.status_code == 422
    assert f"{unknown.public.hex()}, which no robot has" in answer.json()["detail"]
    answer = carrier.add(bundle, "arm3")
    assert (answer.status_code, "'arm3' is not enrolled" in answer.text) == (404, True)
    assert carrier.stored() == []
    site.run("robot", "remove", "arm1")
    assert carrier.add(bundle, "arm1").status_code == 201, "evidence of a removed robot is still evidence"


def test_a_bundle_of_a_rewritten_log_is_refused(
    carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1")
    robot.record(30)
    robot.push()
    robot.close()
    robot.rewind(2)
    bundle = incident(robot, tmp_path / "incident.zip").read_bytes()
    answer = carrier.add(bundle)
    assert answer.status_code == 422
    assert "checkpoint 3: differs from the one kept elsewhere" in answer.json()["detail"]
    assert carrier.stored() == []
    robot.push()
    assert carrier.add(bundle).status_code == 201, "now the fork is collected, and reported"
    assert carrier.site.health()["robots"][0]["forks"] > 0


def test_sizes_have_limits(site: FleetSite, make_robot: MakeRobot, tmp_path: Path) -> None:
    operator, robot = Operator(site, tmp_path / "operator"), make_robot("arm1")
    first, second = (incident(robot, tmp_path / f"{number}.zip") for number in (1, 2))
    robot_bytes = first.stat().st_size + second.stat().st_size - 1
    site.write_config(evidence={"bundle_bytes": 100_000, "robot_bytes": robot_bytes})
    site.stop()
    site.start()
    large = tmp_path / "large.zip"
    large.write_bytes(bytes(50_000_000))
    refused = operator.remote("evidence", "add", str(large), "--robot", "arm1", status=1)
    assert "at most 100000 bytes (evidence.bundle_bytes)" in refused
    operator.remote("evidence", "add", str(first), "--robot", "arm1")
    refused = operator.remote("evidence", "add", str(second), "--robot", "arm1", status=1)
    assert "raise evidence.robot_bytes" in refused
    assert len(operator.remote("evidence", "list").splitlines()) == 1


def _begin_upload(carrier: Carrier) -> ssl.SSLSocket:
    context = ssl.create_default_context(cafile=carrier.site.server.ca)
    plain = socket.create_connection(("127.0.0.1", carrier.site.port), 30)
    secured = context.wrap_socket(plain, server_hostname="127.0.0.1")
    head = f"POST /v1/evidence?robot=arm1 HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {carrier.token}\r\n"
    secured.sendall(f"{head}Content-Length: 200000\r\n\r\n".encode() + bytes(100_000))
    eventually(lambda: list(carrier.incoming.glob("*/bundle.zip")), "the upload has begun")
    return secured


def test_a_kill_leaves_nothing_half_stored(
    site: FleetSite, carrier: Carrier, make_robot: MakeRobot, tmp_path: Path
) -> None:
    bundle = incident(make_robot("arm1"), tmp_path / "incident.zip").read_bytes()
    with _begin_upload(carrier):
        site.kill()
    assert list(carrier.incoming.iterdir())
    site.start()
    assert carrier.stored() == []
    with _begin_upload(carrier):
        pass
    eventually(lambda: not list(carrier.incoming.iterdir()), "the upload is removed")
    assert carrier.stored() == []
    assert carrier.add(bundle).status_code == 201
    site.kill()
    site.start()
    assert [one["robot"] for one in carrier.stored()] == ["arm1"]
    assert acts_of(carrier.site) == [("olga", "evidence add", "arm1")]


def test_a_full_disk_refuses_evidence_before_segments(database: str, tmp_path: Path) -> None:
    with (
        small_disk(tmp_path / "disk", "4m") as disk,
        running(FleetSite(tmp_path / "site", database, {"reserve_bytes": 500_000}, disk / "data")) as site,
    ):
        carrier, robot = Carrier(site), FleetRobot(site, "arm1")
        bundle = incident(robot, tmp_path / "incident.zip").read_bytes()
        (disk / "filler").write_bytes(bytes(shutil.disk_usage(disk).free - 900_000))
        answer = carrier.add(bundle)
        assert (answer.status_code, answer.headers["Retry-After"]) == (503, "60")
        assert "evidence needs twice limits.reserve_bytes" in answer.json()["detail"]
        assert carrier.stored() == []
        assert acts_of(carrier.site) == []
        robot.push()
        (disk / "filler").unlink()
        assert carrier.add(bundle).status_code == 201
        assert len(carrier.stored()) == 1
        robot.close()
