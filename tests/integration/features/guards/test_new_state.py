"""Guards of the configuration are in force with a new state directory, as after another card or `apt purge`."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.channel import admin
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.waiting import eventually

NEW = ("guard", "new", "deadman", "/cmd_vel", "--type", "command=geometry_msgs/Twist")


@pytest.fixture(scope="module")
def host(common_lab: Lab) -> Host:
    return common_lab.host("packaged", "10.77.0.7/24")


@pytest.fixture
def packaged(host: Host) -> Iterator[Appliance]:
    """An appliance with the package's `enable: none`."""
    running = Appliance(host, settings="enable: none\n", options=("--api", "off"), monitors={})
    try:
        yield running.start()
    finally:
        running.close()


def with_new_state(appliance: Appliance) -> None:
    assert appliance.stop() == 0
    shutil.rmtree(appliance.state)
    appliance.start()


def states(appliance: Appliance) -> dict[str, str]:
    return {row.name: row.lasting for row in appliance.ask(admin.MonitorsWanted()).monitors}


@pytest.mark.real
def test_a_base_that_goes_silent_is_stopped_with_a_new_state_directory(
    packaged: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    packaged.rosrv(*NEW)
    with_new_state(packaged)
    assert packaged.rosrv("status").returncode == 0
    with RosSession(packaged.master_uri, tmp_path, common_robot) as ros:
        base = ros.node("rospy", "driven_base", "0")
        driver = ros.node("rospy", "driver", name="driver")
        base.wait_for(event="moves")
        mark = base.mark()
        driver.kill()
        base.wait_for(event="stands", since=mark)


def test_the_file_has_each_switch_and_a_file_without_one_is_a_warning(packaged: Appliance) -> None:
    packaged.rosrv(*NEW)
    file = packaged.directory / "monitors" / "deadman.rv"
    for orders, word in (
        ((("monitor", "disable", "deadman"),), "off"),
        ((("monitor", "enable", "deadman", "--shadow"),), "shadow"),
        ((("guard", "enforce", "deadman", "--confirm-within", "5m"), ("monitor", "confirm")), "on"),
        ((("monitor", "disable", "deadman", "--for", "10m"),), "on"),
    ):
        for order in orders:
            packaged.rosrv(*order)
        assert file.read_text().startswith(f"preset deadman 3 as deadman {word} {{\n"), word
        with_new_state(packaged)
        assert states(packaged) == {"deadman": word}
    file.write_text(file.read_text().replace(" on {", " {", 1))  # a guard of 0.4.0
    with_new_state(packaged)
    assert states(packaged) == {"deadman": "off"}
    done = packaged.rosrv("status", check=False)
    assert done.returncode == 1
    assert "rosrv monitor enable deadman" in " ".join(done.stdout.split())
    tested = packaged.rows("selftest")
    assert any(row["outcome"] == "warn" and "deadman" in row["text"] for row in tested)
    packaged.rosrv("monitor", "enable", "deadman")
    assert file.read_text().startswith("preset deadman 3 as deadman on {\n")
    eventually(lambda: packaged.rosrv("status", check=False).returncode == 0, packaged.story)
