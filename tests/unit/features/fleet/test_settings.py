import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from appliance.configuration.config_sources import ConfigError, read, resolve
from appliance.features.fleet.settings import Fleet


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "appliance.yaml"


def mistakes(file: Path | None, flags: dict[str, Any]) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        resolve(file, {}, flags)
    return [str(mistake) for mistake in caught.value.mistakes]


def joined(state: Path) -> Path:
    folder = state / "joined"
    folder.mkdir(parents=True)
    section = {
        "collector": "https://10.0.0.9:8444", "robot": "arm7", "ca": "collector.pem", "certificate": "robot.pem",
        "key": "robot.key", "receipt_key": "receipts.pub", "bundles": {"site": "site-a", "group": "arms"},
    }  # fmt: skip
    (folder / "fleet.json").write_text(json.dumps(section))
    return folder


def test_a_join_gives_the_section_fleet(file: Path, tmp_path: Path) -> None:
    folder = joined(tmp_path / "state")
    state = {"state": tmp_path / "state"}
    fleet = resolve(None, {}, state).of(Fleet)
    assert (fleet.collector, fleet.robot) == ("https://10.0.0.9:8444", "arm7")
    assert fleet.key == folder / "robot.key"
    assert (fleet.bundles.site, fleet.bundles.group, fleet.bundles.root) == ("site-a", "arms", None)
    file.write_text(
        "state: state\naudit: {retention_days: 9}\nfleet: {retention_waits: true, bundles: {root: root.json}}\n"
    )
    fleet = resolve(file, {}, {}).of(Fleet)
    assert (fleet.collector, fleet.retention_waits) == ("https://10.0.0.9:8444", True)
    assert (fleet.bundles.root, fleet.bundles.group) == (tmp_path / "root.json", "arms")
    file.write_text(
        "state: state\nfleet: {collector: 'https://10.0.0.8:1', ca: a, certificate: b, key: c, receipt_key: d}\n"
    )
    fleet = resolve(file, {}, {}).of(Fleet)
    assert (fleet.collector, fleet.robot, fleet.key) == ("https://10.0.0.8:1", "", tmp_path / "c")


def test_a_damaged_join_is_a_mistake(tmp_path: Path) -> None:
    (joined(tmp_path) / "fleet.json").write_text("{")
    (found,) = mistakes(None, {"state": tmp_path})
    assert found.startswith(f"{tmp_path}/joined/fleet.json: cannot be used: ")
    assert found.endswith("join again: rosrv fleet join FILE")


def test_wrong_bundles_beside_a_join_are_a_mistake(file: Path, tmp_path: Path) -> None:
    joined(tmp_path / "state")
    file.write_text("state: state\nfleet: {bundles: 3}\n")
    (found,) = mistakes(file, {})
    assert "bundles" in found


_FLEET = {"collector": "https://10.0.0.9:8444", "ca": "a", "certificate": "b", "key": "c", "receipt_key": "d"}


def test_a_collector() -> None:
    assert read({"fleet": _FLEET}).of(Fleet).destination == ("10.0.0.9", 8444)
    bundles = {"robot": "arm1", "bundles": {"root": "r", "site": "s", "group": "g"}}
    only_bundles = {name: value for name, value in _FLEET.items() if name != "receipt_key"} | bundles
    assert read({"fleet": only_bundles}).of(Fleet).receipt_key is None


@pytest.mark.parametrize(
    ("fleet", "why"),
    [
        (_FLEET | {"collector": "http://10.0.0.9:8444"}, "is not https://"),
        (_FLEET | {"collector": "https://10.0.0.9:8444/"}, "is not https://"),
        (_FLEET | {"collector": "https://fleet.example:8444"}, "names are not looked up"),
        (_FLEET | {"collector": "https://127.0.0.1:8444"}, "loopback of the appliance's own namespace"),
        (
            {name: value for name, value in _FLEET.items() if name != "receipt_key"},
            "collector needs receipt_key, to push segments, or bundles.root",
        ),
        ({"ca": "x.pem"}, "no effect without a collector: remove it"),
        (_FLEET | {"bundles": {"root": "r", "site": "s", "group": "g"}}, "robot must be given"),
        (_FLEET | {"bundles": {"root": "r", "site": "s"}}, "root needs site and group"),
        (_FLEET | {"retention_waits": True}, "no effect without audit.retention_days"),
    ],
)
def test_an_invalid_collector_is_rejected(fleet: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        read({"fleet": fleet})
