"""A robot whose bundle gate, link, state and trail are real; its revisions are texts with their authors."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from appliance.control.assembly.policies import RevisionChangedError
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered, BundlePollReported, BundleStated
from appliance.features.fleet.settings import Bundles, Fleet
from appliance.features.fleet.view import BundlesState
from appliance.formats.bundle_archive import BundleContents
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.specifications.switches import Switches
from appliance.store.state_file import RevisionRow
from tests.support.core import Core
from tests.support.memory_channel import memory_link

OFFER = BundleOffered("site-a/arms/2.tar", "2" * 64, BundleContents("[Nodes]\n# of the bundle\n", ""))
BEFORE, OF_OPERATOR = "[Nodes]\n# before\n", "[Nodes]\n# of an operator\n"
FLEET = Fleet(
    collector="https://10.0.0.9:8444", ca=Path("ca"), certificate=Path("robot.pem"), key=Path("robot.key"),
    robot="arm7", bundles=Bundles(root=Path("root.json"), site="site-a", group="arms"),
)  # fmt: skip
_HEALTHY = RobotHealth(0, frozenset(), frozenset())
_compiled = cache(compile_policy)


class Revisions:
    """The policy, or the specifications with their rollout."""

    checked, switches, sources = CheckedSpecifications(), Switches(), ""
    held = frozenset[str]()

    def __init__(self) -> None:
        self.rows = [RevisionRow(1, BEFORE, "", 0.0, "", "")]
        self.rollout = self
        self.confirm_by: float | None = None
        self.would_hold: list[str] = []
        self.meanwhile: Callable[[], object] = lambda: None
        """Called once, while an order waits."""

    @property
    def revision(self) -> int:
        return self.in_force.revision

    tag = revision

    @property
    def in_force(self) -> RevisionRow:
        return self.rows[-1]

    @property
    def current(self) -> Policy:
        return _compiled(self.in_force.text, file="policy.ini")

    def change(self, who: str, text: str = OF_OPERATOR) -> RevisionRow:
        self.rows.append(RevisionRow(len(self.rows) + 1, text, "", 0.0, who, ""))
        return self.in_force

    async def attempt(self, *_content: object) -> None:
        """All policies pass."""

    async def held_by_bundle(self, _sources: object) -> list[str]:
        return self.would_hold

    async def load_with(self, load: Any, who: str, _cases: object) -> RevisionRow:
        self._wait(load.expected)
        return self.change(who, load.text)

    async def take_bundle(self, _sources: object, who: str, _note: str, expected: int) -> RevisionRow:
        self._wait(expected)
        return self.change(who, "of the bundle")

    async def roll_back(self, order: Any, who: str) -> None:
        self._wait(order.expected)
        self.change(who, self.rows[order.revision - 1].text)

    def _wait(self, expected: int | None) -> None:
        happens, self.meanwhile = self.meanwhile, lambda: None
        happens()
        if expected not in (None, self.tag):
            raise RevisionChangedError(expected or 0, self.revision)


class BundleRobot:
    def __init__(self, folder: Path, fleet: Fleet = FLEET) -> None:
        core = Core(folder)
        self.trail, self.store, self.hosts = core.trail, core.store, TunnelHosts()
        self.policies, self.monitors = Revisions(), Revisions()
        self.stated: list[BundleStated] = []
        revisions: Any = {"policies": self.policies, "monitors": self.monitors}
        self.gate = BundleGate(
            fleet, **revisions, hosts=lambda: self.hosts, store=core.store, trail=core.trail,
            health=lambda _deprived: _HEALTHY,
        )  # fmt: skip
        near, self.poller = memory_link(BundleLink)
        self.gate.link.attach(near)

    def poll(self, *, offered: bool) -> None:
        """Send what a poll sends."""
        if offered:
            self.poller.send(OFFER)
        self.poller.send(BundlePollReported(1.0, offered=offered))

    @property
    def state(self) -> BundlesState:
        state = self.gate.status()
        assert state is not None
        return state

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        self.poller.attach(
            asyncio.get_running_loop(), lambda stated, _given: self.stated.append(stated), lambda: None
        )
        running = asyncio.create_task(self.gate.run())
        yield
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
