"""Guards of the configuration are in force with a new state directory, as after another card or `apt purge`."""

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from appliance.channel import admin
from appliance.control.operators.new_state import LACKS
from appliance.features.guards.presets import PRESETS, Guard, text_of
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.rosmaster import call_on
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
        assert re.match(rf"preset deadman \d+ as deadman {word} {{\n", file.read_text()), word
        with_new_state(packaged)
        assert states(packaged) == {"deadman": word}
    file.write_text(file.read_text().replace(" on {", " {", 1))  # a guard of 0.4.0
    with_new_state(packaged)
    assert states(packaged) == {"deadman": "off"}
    done = packaged.rosrv("status", check=False)
    assert done.returncode == 1
    assert "rosrv monitor enable deadman" in " ".join(done.stdout.split())
    packaged.rosrv("monitor", "enable", "deadman")
    assert re.match(r"preset deadman \d+ as deadman on {\n", file.read_text())
    eventually(lambda: packaged.rosrv("status", check=False).returncode == 0, packaged.story)


Part = tuple[Sequence[Sequence[str]], Callable[[Appliance], object]]
"""A part of a state directory: the orders that change it, and a look at it."""


def names(*command: str, of: str) -> Callable[[Appliance], object]:
    return lambda appliance: {row[of] for row in appliance.rows(*command)}


def fastest(appliance: Appliance) -> object:
    [speed] = [row for row in appliance.ask(admin.MonitorsWanted()).monitors if row.name == "speed"]
    return {one.name: one.value for one in speed.given}["vMax"]


def parameter(appliance: Appliance) -> object:
    return call_on(appliance.host, appliance.master_uri, "hasParam", "/t", "/there")[2]


def log_key(appliance: Appliance) -> object:
    file = appliance.state / "control" / "audit.pub"
    return eventually(lambda: file.read_text() if file.exists() else "", appliance.story)


PARTS: dict[str, Part] = {
    "switches": ([("monitor", "enable", "own")], lambda one: states(one)["own"]),
    "values": ([("guard", "set", "speed", "vMax=0.2")], fastest),
    "loaded specifications": ([("monitor", "load", "loaded.rv")], lambda one: "loaded" in states(one)),
    "policy revisions": ([("policy", "rollback", "1")], names("policy", "revisions", of="revision")),
    "blocks": ([("host", "block", "10.77.0.99", "--for", "1h")], names("host", "blocks", of="address")),
    "tokens": ([("token", "add", "eve", "--for", "1d")], names("token", "list", of="name")),
    "doors": ([("door", "add", "eve")], names("door", "list", of="name")),
    "registrations": ([], parameter),
    "handled alarms": (
        [("alarm", "silence", "guard-off:speed", "--for", "1h")],
        lambda one: len(one.status()["handled_alarms"]),
    ),
    "audit log": ([], log_key),
}
ELSEWHERE = {
    "enrolled hosts": "needs tunnels: tests/system/ipsec",
    "adoption": "needs a robot's own master: tests/system/network/test_adopt.py",
    "memberships": "needs a collector or a second appliance: tests/system/features",
}
OWN = "own() { event e() /own std_msgs/Bool '{}' { } }"


def test_a_new_state_directory_lacks_each_part_of_the_earlier_one_and_says_so(packaged: Appliance) -> None:
    """Each part differs after its orders, and is as at the first start with a new state directory."""
    assert PARTS.keys() | ELSEWHERE.keys() == LACKS.keys()
    folder = packaged.directory / "monitors"
    (folder / "own.rv").write_text(OWN)
    (folder / "speed.rv").write_text(text_of(Guard("speed", PRESETS["speed"])))
    loaded = packaged.directory / "loaded.rv"
    loaded.write_text(OWN.replace("own()", "loaded()"))
    with_new_state(packaged)
    first = {name: look(packaged) for name, (_orders, look) in PARTS.items()}
    policy = packaged.policy_file.read_text()
    packaged.policy_file.write_text(f"{policy}# 2\n")
    call_on(packaged.host, packaged.master_uri, "setParam", "/t", "/there", 1)
    for orders, _look in PARTS.values():
        for order in orders:
            packaged.rosrv(*(str(loaded) if word == "loaded.rv" else word for word in order))
    used = {name: look(packaged) for name, (_orders, look) in PARTS.items()}
    assert [name for name in PARTS if used[name] == first[name] and name != "audit log"] == []
    named = packaged.row("backup", str(packaged.directory / "backup.tar.gz"))["only_in_state"]
    assert named == ["loaded.rv"]
    with_new_state(packaged)
    new = {name: look(packaged) for name, (_orders, look) in PARTS.items()}
    assert [name for name in PARTS if new[name] != first[name]] == ["audit log"]
    [record] = packaged.recorded(event="state directory new")
    assert record["detail"]["parts"] == dict(LACKS)
    assert packaged.status()["new_state"]["lacks"] == [*LACKS]
