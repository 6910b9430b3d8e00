import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from appliance.features.fleet.connection import CollectorError, robot_connection
from fleet.tests.support.fleet_site import FleetSite
from tests.support.appliance import Appliance
from tests.support.certificates import make_certificates
from tests.support.sources import ROOT
from tests.support.waiting import eventually
from tests.system.fleet.test_appliance import pushing

BUNDLE = "site-a/arms/1.tar"
PAGE_METRICS = set(re.findall(r"`(rosrv_fleet_\w+)`", (ROOT / "docs/reference/fleet.md").read_text()))
POLICY = (
    "[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n[Subscribers]\ndefault = *\n[Commands]\ndefault = *\n"
    "# of the bundle\n"
)


class Operator:
    def __init__(self, site: FleetSite, folder: Path) -> None:
        self._site = site
        self.repository = folder / "repository"
        self._files = folder / "arms"
        self._files.mkdir(parents=True)
        (self._files / "policy.ini").write_text(POLICY)
        (self._files / "hosts.yaml").write_text("hosts: []\n")
        self._passphrase = folder / "passphrase"
        self._passphrase.write_text("a passphrase for tests\n")
        self.token = folder / "token"
        self.token.write_text(site.run("token", "add", "olga", "--role", "operator").stdout)
        self.viewer = folder / "viewer"
        self.viewer.write_text(site.token)

    def run(self, *arguments: str, status: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "rosrv_fleet", *arguments], capture_output=True, text=True, check=False,
            env=os.environ | {"PYTHONPATH": str(ROOT / "fleet" / "src")},
        )  # fmt: skip
        assert done.returncode == status, f"{arguments}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout + done.stderr

    def publish(self, folder: Path) -> None:
        here = ("--repository", str(self.repository))
        secret = ("--passphrase-file", str(self._passphrase))
        self.run("bundle", "init", *here, *secret)
        self.run("bundle", "delegate", "site-a/arms", *here, *secret)
        self.run("bundle", "add", "site-a/arms", str(self._files), *here, *secret)
        self.run("bundle", "publish", str(folder), *here)

    def rollout(self, verb: str, *arguments: str, token: Path | None = None, status: int = 0) -> str:
        return self.remote("rollout", verb, *arguments, token=token, status=status)

    def remote(self, *arguments: str, token: Path | None = None, status: int = 0) -> str:
        url, ca = f"https://{self._site.address}:{self._site.port}", str(self._site.server.ca)
        access = ("--collector", url, "--ca", ca, "--token-file", str(token or self.token))
        return self.run(*arguments, *access, status=status)

    def group(self) -> dict[str, Any]:
        (group,) = json.loads(self.rollout("status", "--json", token=self.viewer))["groups"]
        return dict(group["rollout"] or {})


def serve_bundles(site: FleetSite, operator: Operator) -> None:
    folder = site.folder / "bundles"
    operator.publish(folder)
    key = operator.repository / "timestamp.pem"
    site.write_config(bundles={"folder": str(folder), "timestamp_key": str(key)})
    site.stop()
    site.start()


def make_appliance(site: FleetSite, operator: Operator) -> Appliance:
    appliance = Appliance()
    fleet = pushing(site, appliance.directory)
    root = appliance.directory / "fleet" / "root.json"
    root.write_bytes((operator.repository / "root.json").read_bytes())
    root.chmod(0o644)
    bundles = {
        "root": "fleet/root.json",
        "site": "site-a",
        "group": "arms",
        "interval": 5,
        "confirm_seconds": 1,
    }
    settings = {
        "audit": {"checkpoint_seconds": 1, "retention_days": 30},
        "fleet": fleet | {"robot": "arm1", "bundles": bundles},
    }
    (appliance.directory / "appliance.yaml").write_text(json.dumps(settings))
    appliance.options = ("--config", str(appliance.directory / "appliance.yaml"))
    return appliance


@pytest.mark.skipif(os.geteuid() != 0, reason="the appliance's processes have users of their own")
def test_an_appliance_pushes_its_log_and_takes_a_bundle(site: FleetSite, tmp_path: Path) -> None:
    operator = Operator(site, tmp_path / "operator")
    serve_bundles(site, operator)
    with make_appliance(site, operator) as appliance:
        eventually((appliance.state / "control" / "audit.pub").exists, "the log's key is there")
        certificate = str(appliance.directory / "fleet" / "peer.pem")
        site.run(
            "robot", "add", "arm1", "--key", str(appliance.state / "control" / "audit.pub"),
            "--certificate", certificate, "--group", "site-a/arms",
        )  # fmt: skip
        refused = operator.rollout("start", BUNDLE, token=operator.viewer, status=1)
        assert "the role viewer; this needs operator" in refused
        operator.rollout("start", BUNDLE)
        eventually(
            lambda: operator.group()["rings"][0]["in_force"] == 1,
            lambda: f"the bundle is in force: {operator.group()}\n{appliance.story()}",
        )
        assert "# of the bundle" in appliance.rosrv("policy", "show").stdout
        assert appliance.status()["bundles"]["in_force"] == BUNDLE
        (robot,) = site.get("/v1/rollouts/site-a/arms").json()["robots"]
        assert (robot["name"], robot["in_force"]) == ("arm1", BUNDLE)
        eventually(lambda: site.search(robot="arm1", event="bundle in force"), "its record is searchable")
        with site.client() as client:
            page = client.get("/rollouts", headers={"Cookie": f"__Host-rosrv-fleet={site.token}"})
        assert BUNDLE in page.text
        metrics = site.get("/metrics").text
        assert set(re.findall(r"^# TYPE (\w+)", metrics, re.MULTILINE)) == PAGE_METRICS
        assert 'rosrv_fleet_robots{condition="in force",group="arms",site="site-a"} 1.0' in metrics
        assert 'rosrv_fleet_rollout{group="arms",site="site-a",state="stopped"} 0.0' in metrics
        assert "rosrv_fleet_rollouts_up 1.0" in metrics
        site.stop()  # while the robot's event stream is open
        assert "graceful shutdown exceeded" not in (site.folder / "log").read_text()
    (proof,) = map(json.loads, site.run("verify", "--json").stdout.splitlines())
    assert (proof["ok"], proof["missing"]) == (True, 0)


def test_only_enrolled_robots_get_bundles(site: FleetSite, tmp_path: Path) -> None:
    operator = Operator(site, tmp_path / "operator")
    assert "without the section `bundles`" in operator.rollout("status", status=1)
    serve_bundles(site, operator)
    for path in ("metadata/timestamp.json", "metadata/1.root.json", "selection/site-a/arms"):
        assert site.get(f"/v1/bundles/{path}").status_code == 403
    assert site.get("/v1/rollouts", token=None).status_code == 401


def test_the_pusher_checks_the_name_in_the_certificate(site: FleetSite, tmp_path: Path) -> None:
    robot = make_certificates(tmp_path / "robot", authority="authority of arm1")
    url, files = f"https://127.0.0.1:{site.port}", (site.server.ca, robot.certificate, robot.key)
    with pytest.raises(CollectorError, match=r"not valid for 'fleet\.example'"):
        robot_connection(url, *files, "fleet.example").get(f"v1/logs/{'0' * 32}")
