import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fleet.tests.support.bundle_site import GROUP, ROBOT, SITE, BundleSite, bundle_files
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import RosSession
from tests.support.rosmaster import master_at
from tests.support.waiting import eventually

CLOSED_POLICY = "[Nodes]\ndefault = *\n"
MONITOR = """\
quiet() {
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        ROS_INFO("%s", text.c_str());
    }
}
"""
LATCH = """\
latch() {
    bool on;
    event stop(bool b) /stop std_msgs/Bool '{data:b}' { on = !b; }
    event said() /chatter std_msgs/String '{}' { if (!on) { return; } }
}
"""


@pytest.fixture(scope="module")
def site() -> Iterator[tuple[BundleSite, str]]:
    folder = Path(tempfile.mkdtemp(prefix="rosrv-fleet-"))
    folder.chmod(0o755)
    made = BundleSite(folder / "site")
    made.publish()
    with made.served() as url:
        yield made, url
    shutil.rmtree(folder)


@contextmanager
def robot(site: BundleSite, url: str, **bundles: Any) -> Iterator[Appliance]:
    certificate, key = site.authority.issue(ROBOT)
    for file in (site.folder, key):
        file.chmod(0o755)
    root = site.folder / "root.json"
    root.write_bytes(site.first_root)
    wanted = {"root": str(root), "site": SITE, "group": GROUP, "interval": 2, "confirm_seconds": 2, **bundles}
    fleet = {
        "collector": url,
        "robot": ROBOT,
        "ca": str(site.authority.ca),
        "certificate": str(certificate),
        "key": str(key),
        "bundles": wanted,
    }
    with Appliance(settings=json.dumps({"fleet": fleet})) as appliance:
        yield appliance


def bundles_of(appliance: Appliance) -> dict[str, Any]:
    return dict(appliance.status()["bundles"])


def in_force(appliance: Appliance, path: object) -> dict[str, Any]:
    def found() -> dict[str, Any] | None:
        state = bundles_of(appliance)
        return state if state["in_force"] == str(path) and not state["trying"] else None

    return eventually(found, lambda: f"{bundles_of(appliance)}\n{appliance.story()}")


def test_a_bundle_comes_into_force(site: tuple[BundleSite, str]) -> None:
    served, url = site
    with robot(served, url) as appliance:
        path = served.add(bundle_files(OPEN_POLICY + "# of the bundle\n"))
        in_force(appliance, path)
        assert "# of the bundle" in appliance.rosrv("policy", "show").stdout
        assert appliance.recorded(event="bundle in force")[0]["detail"]["bundle"] == str(path)
        eventually(lambda: reported(served, path), "a report of the bundle in force")


def refused(appliance: Appliance, path: object) -> str:
    def found() -> str | None:
        state = bundles_of(appliance)
        return str(state["reason"]) if state["refused"] == str(path) and not state["trying"] else None

    return eventually(found, lambda: f"{bundles_of(appliance)}\n{appliance.story()}")


def refusal(appliance: Appliance, path: object) -> dict[str, Any]:
    def found() -> dict[str, Any] | None:
        details = [record["detail"] for record in appliance.audit(event="bundle refused")]
        return next((detail for detail in details if detail["bundle"] == str(path)), None)

    return eventually(found, appliance.story)


@pytest.fixture(scope="module")
def appliance(site: tuple[BundleSite, str]) -> Iterator[Appliance]:
    served, url = site
    with robot(served, url) as appliance:
        in_force(appliance, served.add(bundle_files(OPEN_POLICY)))
        yield appliance


def test_bad_bundles_are_refused_with_the_reason(site: tuple[BundleSite, str], appliance: Appliance) -> None:
    served, _url = site
    before = bundles_of(appliance)["in_force"]
    revision = appliance.status()["policy"]["revision"]
    cases = "- {deny: publish, node: /a, host: 10.0.0.1, topic: /chatter}\n"
    bad = {
        "case": bundle_files(OPEN_POLICY, policy_dot_ini_dot_tests_dot_yaml=cases),
        "error": bundle_files("[Nodes]\nnonsense\n"),
        "broken.rv": bundle_files(OPEN_POLICY, monitors__broken_dot_rv="broken() {"),
        "hosts.yaml": bundle_files(OPEN_POLICY, hosts_dot_yaml="hosts: [{name: 1}]\n"),
    }
    for word, files in bad.items():
        path = served.add(files)
        assert word in refused(appliance, path)
        assert word in str(refusal(appliance, path)["findings"])
        assert bundles_of(appliance)["in_force"] == before
        assert appliance.status()["policy"]["revision"] == revision
    assert appliance.rosrv("status", check=False).returncode == 1
    in_force(appliance, served.add(bundle_files(OPEN_POLICY)))


def test_an_unhealthy_bundle_goes_back_in_all_parts(site: tuple[BundleSite, str]) -> None:
    served, url = site
    served.selection = ""  # an earlier bundle would be tried for as long
    with robot(served, url, confirm_seconds=120) as appliance:
        hosts = "hosts: [{name: ocu-9}]\n"
        files = bundle_files(CLOSED_POLICY, hosts_dot_yaml=hosts, monitors__quiet_dot_rv=MONITOR)
        path = served.add(files)
        eventually(lambda: bundles_of(appliance)["trying"] == str(path), appliance.story)
        eventually(lambda: appliance.status()["monitors"]["loaded"] == 1, appliance.story)
        eventually(
            lambda: "Publishers" not in appliance.rosrv("policy", "show").stdout,
            "the bundle's policy is in force",
        )
        with master_at(appliance.master_uri) as master:
            for number in range(30):
                master.setParam("/worker", f"/value{number}", number)
        eventually(lambda: "denials" in bundles_of(appliance)["trouble"], appliance.story)
        assert not bundles_of(appliance)["refused"], "it was tried right after the start"
        assert appliance.status()["monitors"]["loaded"] == 0
        assert "Publishers" in appliance.rosrv("policy", "show").stdout
        assert "ocu-9" not in appliance.rosrv("host", "list").stdout


def test_a_bundle_that_would_hold_a_moving_topic_waits(site: tuple[BundleSite, str], tmp_path: Path) -> None:
    served, url = site
    served.selection = ""
    with robot(served, url) as appliance:
        in_force(appliance, served.add(bundle_files(OPEN_POLICY, monitors__latch_dot_rv=LATCH)))
        with RosSession(appliance.master_uri, tmp_path) as ros:
            ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: false")
            talker = ros.talker("roscpp", "/chatter")
            path = served.add(bundle_files(OPEN_POLICY, monitors__latch_dot_rv=LATCH.replace("on", "is_on")))
            eventually(lambda: "latch loses its state" in bundles_of(appliance)["trouble"], appliance.story)
            assert not bundles_of(appliance)["refused"]
            assert appliance.status()["monitors"]["held"] == []
            talker.stop()
        eventually(lambda: bundles_of(appliance)["in_force"] == str(path), appliance.story, seconds=120.0)
        assert appliance.status()["monitors"]["held"] == ["latch"]


def test_a_kill_while_unconfirmed_goes_back_and_tries_again(site: tuple[BundleSite, str]) -> None:
    served, url = site
    with robot(served, url, confirm_seconds=10) as appliance:
        path = served.add(bundle_files(OPEN_POLICY + "# tried\n", monitors__quiet_dot_rv=MONITOR))
        eventually(lambda: bundles_of(appliance)["trying"] == str(path), appliance.story)
        eventually(lambda: "# tried" in appliance.rosrv("policy", "show").stdout, appliance.story)
        appliance.kill("control")
        state = in_force(appliance, path)
        assert not state["refused"]
        notes = appliance.rosrv("policy", "revisions").stdout
        assert "rolled back" in notes
        assert appliance.status()["monitors"]["loaded"] == 1


def test_a_change_on_the_robot_is_reported(site: tuple[BundleSite, str]) -> None:
    served, url = site
    with robot(served, url) as appliance:
        in_force(appliance, served.add(bundle_files(OPEN_POLICY, monitors__quiet_dot_rv=MONITOR)))
        assert not bundles_of(appliance)["changed"]
        appliance.reload(OPEN_POLICY + "# by hand\n")
        assert bundles_of(appliance)["changed"]
        assert "# by hand" in appliance.rosrv("policy", "show").stdout
        eventually(lambda: changed(served), "a report of the change")
        appliance.reload(OPEN_POLICY)
        assert not bundles_of(appliance)["changed"]
        appliance.rosrv("monitor", "disable", "quiet")
        assert bundles_of(appliance)["changed"]
        appliance.rosrv("monitor", "enable", "quiet")
        assert not bundles_of(appliance)["changed"]


def changed(site: BundleSite) -> bool:
    return any(site.reports.get()[1]["changed"] for _ in range(site.reports.qsize()))


def test_a_lying_collector_is_an_alarm(site: tuple[BundleSite, str]) -> None:
    served, url = site
    with robot(served, url) as appliance:
        path = served.add(bundle_files(OPEN_POLICY))
        in_force(appliance, path)
        served.selection = "site-b/arms/7.tar"
        served.wake()
        record = appliance.recorded(event="bundle metadata rejected")[0]
        assert "other robots" in record["reason"]
        assert bundles_of(appliance)["rejected"]
        assert bundles_of(appliance)["in_force"] == str(path)
        served.selection = str(path)


def reported(site: BundleSite, path: object) -> bool:
    while not site.reports.empty():
        name, report = site.reports.get()
        assert name == ROBOT
        if report["in_force"] == str(path):
            return True
    return False
