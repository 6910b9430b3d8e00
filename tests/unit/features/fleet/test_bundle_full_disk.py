import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from appliance.channel import admin
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered, BundlePollReported
from appliance.features.fleet.settings import Bundles, Fleet
from appliance.formats.bundle_archive import BundleContents
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.switches import Switches
from appliance.store.writer_thread import StoreError
from tests.support.autojump import run
from tests.support.core import FakeTrail
from tests.support.memory_channel import memory_link

_POLICY = "[Nodes]\ndefault = *\n"
_OFFERED = BundleOffered("site-a/arms/2.tar", "2" * 64, BundleContents(_POLICY, "hosts: []\n"))


class Revisions:
    """The policy or the specifications of a robot, of which revision 1 is an operator's."""

    confirm_by = None
    sources = ""
    checked = SimpleNamespace(monitors={})
    rollout = SimpleNamespace(held=frozenset())
    switches = Switches()

    def __init__(self) -> None:
        self.current = compile_policy(_POLICY, file="policy.ini")
        self.owners = ["olga"]

    @property
    def revision(self) -> int:
        return len(self.owners)

    @property
    def in_force(self) -> SimpleNamespace:
        return SimpleNamespace(who=self.owners[-1], signature="")

    async def attempt(self, *_content: object) -> None: ...

    async def held_by_bundle(self, _sources: object) -> list[str]:
        return []

    async def load_with(self, _load: object, who: str, _cases: object) -> None:
        self.owners.append(who)

    async def take_bundle(self, _sources: object, who: str, _note: str) -> None:
        self.owners.append(who)

    async def roll_back(self, order: admin.PolicyRollback | admin.MonitorRollback, _who: str) -> None:
        assert order.revision is not None
        self.owners.append(self.owners[order.revision - 1])


class Hosts:
    bundled = ""

    async def take_bundle(self, text: str, _who: str) -> None:
        self.bundled = text


class Disk:
    """The state file of a robot. It is full at the waits with the numbers `full`."""

    def __init__(self, *full: int) -> None:
        self._full = full
        self._waits = 0
        self.records: list[dict[str, Any]] = []

    def settings(self) -> dict[str, str]:
        return {}

    def save_setting(self, _name: str, value: str) -> None:
        self.records.append(msgspec.json.decode(value))

    async def settled(self) -> None:
        self._waits += 1
        if self._waits in self._full:
            raise StoreError("the state cannot be written: No space left on device")


@pytest.mark.parametrize("wait", [1, 2], ids=["before the trial", "after the trial"])
def test_a_bundle_that_a_full_disk_rolled_back_is_not_in_force_and_is_tried_again(wait: int) -> None:
    policies, monitors, hosts, disk = Revisions(), Revisions(), Hosts(), Disk(wait)
    trail = FakeTrail()
    bundles, file = Bundles(root=Path("root.json"), site="site-a", group="arms"), Path("file.pem")
    fleet = Fleet(
        collector="https://10.0.0.9:8444", robot="arm7", ca=file, certificate=file, key=file, bundles=bundles
    )
    parts: Any = {
        "policies": policies, "monitors": monitors, "hosts": lambda: hosts, "store": disk,
        "trail": trail,
        "health": lambda _deprived: RobotHealth(0, frozenset(), frozenset()),
    }  # fmt: skip
    gate = BundleGate(fleet, **parts)

    def state() -> tuple[str, str, str]:
        found = gate.status()
        assert found is not None
        return found.in_force, found.trying, found.trouble

    async def story() -> None:
        near, far = memory_link(BundleLink)
        gate.link.attach(near)
        running = asyncio.create_task(gate.run())
        far.send(_OFFERED)
        far.send(BundlePollReported(1.0, offered=True))
        await asyncio.sleep(60)
        assert state() == ("", "", "the state cannot be written: No space left on device")
        assert (policies.owners[-1], monitors.owners[-1], hosts.bundled) == ("olga", "olga", "")
        trials = [record.get("trial") is not None for record in disk.records]
        assert trials[-2:] == [True, False], "after a crash in between, the next start rolls back"
        far.send(_OFFERED)
        far.send(BundlePollReported(1.0, offered=True))
        await asyncio.sleep(60)
        assert state() == (_OFFERED.path, "", "")
        assert trail.events == ["bundle in force"]
        running.cancel()

    run(story())
