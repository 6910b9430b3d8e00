from types import SimpleNamespace
from typing import Any

import pytest

from appliance.features.fleet.bundle_gate import BundleGate, Trial
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.formats.bundle_archive import BundleContents
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.specification_files import Sources
from appliance.specifications.switches import Switches

pytestmark = pytest.mark.anyio


class Part:
    """The policy, the specifications and the hosts of a robot, its store and its trail."""

    def __init__(self, enable: str) -> None:
        self.current = compile_policy("[Nodes]\ndefault = robot\n", file="policy.ini")
        self.in_force = SimpleNamespace(signature="")
        self.revision, self.bundled, self.sources = 1, "", Sources({}, {}, {})
        self.checked: Any = SimpleNamespace(monitors={"fence": "fence.rv", "zone": "zone.rv"}, sharing=[])
        self.switches = Switches(enable)
        self.rollout = SimpleNamespace(held=set())
        self.records: list[str] = []

    def settings(self) -> dict[str, str]:
        return {}

    async def settled(self, *_given: object) -> None:
        self.switches.enforce(self.checked)

    load_with = take_bundle = settled

    def save_setting(self, *_given: object) -> None:
        pass

    def happened(self, _event: str, text: str, **_more: object) -> None:
        self.records.append(text)


@pytest.mark.parametrize(
    ("enable", "without"),
    [
        ("all", ""),
        ("shadow", ""),
        ("zone", "; disabled on this robot: fence (rosrv monitor enable)"),
        ("none", "; disabled on this robot: fence, zone (rosrv monitor enable)"),
    ],
)
async def test_a_bundle_in_force_names_the_monitors_that_do_nothing(enable: str, without: str) -> None:
    part: Any = Part(enable)
    health = RobotHealth(0, frozenset(), frozenset())
    gate = BundleGate(
        SimpleNamespace(bundles=SimpleNamespace(confirm_seconds=0.0)),  # type: ignore[arg-type]  # all that it reads
        policies=part, monitors=part, hosts=part, store=part, trail=part, health=lambda _deprived: health,
    )  # fmt: skip
    await gate._try(Trial("s/g/1", "ab", 1, 1, "", ""), BundleContents("", ""))
    assert part.records == [f"s/g/1 is in force, healthy for 0 s{without}"]
