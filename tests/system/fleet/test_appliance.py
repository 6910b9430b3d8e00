import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.signatures import write_public_key
from fleet.tests.support.bundle_site import GROUP, ROBOT, SITE, BundleSite
from fleet.tests.support.fleet_site import FleetSite
from tests.support.appliance import Appliance
from tests.support.certificates import make_certificates
from tests.support.lying_collector import Visitor, lying_collector
from tests.support.rosmaster import master_at
from tests.support.waiting import allowed, eventually

PUSHER = (61023, 61014)  # its user, in the group that may read the log


def pushing(site: FleetSite, folder: Path) -> dict[str, Any]:
    assert site.data is not None
    own = make_certificates(folder / "fleet", authority="authority of arm1")
    shutil.copy(site.server.ca, folder / "fleet" / "collector-ca.pem")
    shutil.copy(site.data / "receipts.pub", folder / "fleet" / "receipts.pub")
    for file in (folder / "fleet").iterdir():
        file.chmod(0o644)
    (folder / "fleet").chmod(0o755)
    return {
        "collector": f"https://127.0.0.1:{site.port}", "ca": "fleet/collector-ca.pem", "certificate": "fleet/peer.pem",
        "key": str(own.key), "receipt_key": "fleet/receipts.pub", "retention_waits": True,
    }  # fmt: skip


def collector_state(appliance: Appliance) -> dict[str, Any]:
    return dict(appliance.status()["audit"]["collector"])


def work(appliance: Appliance, count: int) -> None:
    with master_at(appliance.master_uri) as master:
        for number in range(count):
            assert master.setParam("/worker", f"/value{number}", number)[0] == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="the appliance's processes have users of their own")
def test_an_appliance_pushes_its_log(site: FleetSite) -> None:
    appliance = Appliance()
    (appliance.directory / "appliance.yaml").write_text(
        json.dumps(
            {
                "audit": {"checkpoint_seconds": 1, "retention_days": 30},
                "fleet": pushing(site, appliance.directory),
            }
        )
    )
    appliance.options = ("--config", str(appliance.directory / "appliance.yaml"))
    with appliance:
        work(appliance, 20)
        eventually(
            lambda: collector_state(appliance)["trouble"], "without enrolment the status reports the trouble"
        )
        eventually((appliance.state / "control" / "audit.pub").exists, "the log's key is pinned")
        key = str(appliance.state / "control" / "audit.pub")
        certificate = str(appliance.directory / "fleet" / "peer.pem")
        site.run("robot", "add", "arm1", "--key", key, "--certificate", certificate)
        eventually(lambda: not collector_state(appliance)["trouble"], "segments are pushed")
        (pid,) = eventually(lambda: appliance.pids("fleet"), appliance.story)
        owner = Path(f"/proc/{pid}").stat()
        assert (owner.st_uid, owner.st_gid) == PUSHER
        os.kill(pid, 9)
        site.kill()
        work(appliance, 20)
        site.start()
        exported = map(json.loads, appliance.rosrv("audit", "export").stdout.splitlines())
        last = max(
            one["sequence"] for one in exported if one["event"] != "checkpoint"
        )  # the next one seals that
        eventually(lambda: collector_state(appliance)["sequence"] >= last, "every record is collected")
        assert "rosrv_collector_up 1.0" in appliance.rest().get("/metrics").body.decode()
        assert not site.health()["robots"][0]["off"]
    assert site.health()["robots"][0]["off"]  # it was stopped in order
    (proof,) = map(json.loads, site.run("verify", "--json").stdout.splitlines())
    assert (proof["ok"], proof["missing"]) == (True, 0)
    assert proof["last"] >= last


@pytest.mark.skipif(os.geteuid() != 0, reason="the appliance's processes have users of their own")
def test_a_collector_that_never_answers_holds_nothing_up() -> None:
    appliance = Appliance()
    fleet = BundleSite(appliance.directory / "fleet")
    certificate, key = fleet.authority.issue(ROBOT)
    key.chmod(0o644)
    public = Ed25519PrivateKey.generate().public_key().public_bytes_raw()
    write_public_key(fleet.folder / "receipts.pub", public)
    shutil.copy(fleet.repository.folder / "root.json", fleet.folder / "root.json")
    for file in (fleet.folder, fleet.folder / "receipts.pub", fleet.folder / "root.json"):
        file.chmod(0o755)
    asked: set[bytes] = set()

    def never(visitor: Visitor) -> None:
        asked.add(visitor.request().split()[1].split(b"/")[2])
        visitor.wait()

    with lying_collector(fleet.authority.server_context, never) as url:
        settings = {
            "collector": url, "ca": str(fleet.authority.ca), "certificate": str(certificate), "key": str(key),
            "receipt_key": str(fleet.folder / "receipts.pub"), "retention_waits": True, "robot": ROBOT,
            "bundles": {"root": str(fleet.folder / "root.json"), "site": SITE, "group": GROUP},
        }  # fmt: skip
        config = appliance.directory / "appliance.yaml"
        config.write_text(
            json.dumps({"audit": {"checkpoint_seconds": 1, "retention_days": 30}, "fleet": settings})
        )
        appliance.options = ("--config", str(config))
        with appliance:
            work(appliance, 1)
            eventually(lambda: asked >= {b"logs", b"bundles"}, "both clients wait for an answer")
            began = time.monotonic()
            work(appliance, 50)
            assert time.monotonic() - began < allowed(5)
            eventually(
                lambda: "/value49" in appliance.rosrv("audit", "export").stdout, "the last call is recorded"
            )
            began = time.monotonic()
        assert time.monotonic() - began < allowed(15)
