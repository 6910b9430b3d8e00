"""Histories of two appliances, the witness on the robot, and nodes that use the fixed address.

The promises of `world.py` hold over takeovers, and:

8. At most one appliance is active, and a node's call reaches only an appliance that the robot admits.
9. A takeover loses no acknowledged change: the standby had stored it, or was no longer in sync.
10. Some time after the last fault, one appliance is active, and both are in sync.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from appliance.channel import admin
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.membership import PORT, Membership
from appliance.features.standby.witness.settings import AppliancePeer, WitnessSettings
from tests.world import robot
from tests.world.appliance import MASTER_PORT, Appliance
from tests.world.loop import BrokenPromiseError
from tests.world.network import Address
from tests.world.robot import Robot
from tests.world.world import APPLIANCE, POLICIES, World

ADDRESSES = {"a": "10.0.0.101", "b": "10.0.0.102"}
WITNESS = "10.0.0.10"
_KEYS = {"a": "a1" * 32, "b": "b2" * 32}
_AGAIN_SECONDS = 1.0
_STALL_SECONDS = (0.8, 1.1, 1.6, 3.0, 12.0)


class PairWorld(World):
    pauses = (0.0, 0.05, 0.5, 2.0, 5.0)
    settles = 80.0

    def _make_appliances(self, folder: Path) -> list[Appliance]:
        self._epoch = 0
        settings = WitnessSettings(
            (WITNESS, robot.PORT),
            APPLIANCE,
            (str(MASTER_PORT),),
            {name: AppliancePeer(address, bytes.fromhex(_KEYS[name])) for name, address in ADDRESSES.items()},
            "/lease",
            {},
            "",
        )
        for address in (WITNESS, *ADDRESSES.values()):
            self.machines[address] = self._machine(address)
        self.robot = Robot(self, self.machines[WITNESS], settings)
        self.network.route = self._route
        self.network.reaches = self._reaches  # type: ignore[method-assign]  # the robot's firewall
        return [self._make(name, folder) for name in ADDRESSES]

    def _make(self, name: str, folder: Path) -> Appliance:
        other = "b" if name == "a" else "a"
        membership = Membership(
            name=name,
            other=other,
            address=ADDRESSES[name],
            other_address=ADDRESSES[other],
            fixed=APPLIANCE,
            witness=WITNESS,
            witness_port=robot.PORT,
            port=PORT,
            witness_key=_KEYS[name],
            peer_key="c3" * 32,
            certificate="",
            key="",
            other_certificate="",
        )
        machine, port = self.machines[ADDRESSES[name]], 11312 + (name == "b")
        return Appliance(self, machine, folder / name, self.durability, port, membership)

    def start(self) -> None:
        for appliance in self.appliances:
            appliance.start()

    # --- the robot's firewall ---

    def _route(self, address: Address) -> Address | None:
        return self.robot.translated(address) if address[0] == APPLIANCE else address

    def _reaches(self, source: str, target: str) -> bool:
        ends = {source, target}
        if frozenset(ends) in self.network.cut:
            return False
        ours = ends & set(ADDRESSES.values())
        between = ends <= {*ADDRESSES.values(), WITNESS, "127.0.0.1"}
        return between or all(self.robot.admits(our) for our in ours)

    # --- promises ---

    def activated(self, appliance: Appliance, epoch: int) -> None:
        self.say(f"{appliance.address} is active in epoch {epoch}")
        if any(other.active for other in self.appliances if other is not appliance):
            self.fail("both appliances are active")
        if epoch < self._epoch:
            self.fail(f"{appliance.address} is active in the old epoch {epoch}")
        self._epoch = epoch
        self.appliance = appliance

    async def find_out(self) -> None:
        """Do nothing, because a takeover may still change the policy in force."""

    def control_ready(self, appliance: Appliance) -> None:
        self.loop.outside.start(self._check_policy(appliance))

    async def _check_policy(self, appliance: Appliance) -> str | None:
        possible = self.possible
        answer = await self.order(admin.PolicyWanted())
        if answer is None or self.appliance is not appliance or self.possible != possible:
            return None
        found = next(name for name, policy in POLICIES.items() if policy.text == answer.text)
        if found not in self.possible:
            self.fail(f"the policy {found} is in force, acknowledged was {self.possible}")
        return found

    async def settled(self) -> None:
        active = [appliance for appliance in self.appliances if appliance.active]
        if len(active) != 1 or not active[0].ready:
            raise BrokenPromiseError(f"{len(active)} appliances are active after all faults have ended")
        while (found := await self._check_policy(active[0])) is None:
            await asyncio.sleep(_AGAIN_SECONDS)
        self.possible = {found}
        state: Any = await self.order(standby_requests.StandbyWanted())
        if state is None or not state.other.in_sync:
            raise BrokenPromiseError(f"the standby is not in sync after all faults have ended: {state}")

    # --- faults ---

    def faults(self) -> list[Callable[[], None]]:
        return [
            self.crashes, self.crashes, self.crashes, self.link_is_cut, self.link_is_cut, self.link_is_cut,
            self.switches_over, self.lease_stalls, self.witness_ends, self.control_dies, self.rosmaster_dies,
            self.is_cut_off, self.dies,
        ]  # fmt: skip

    def crashes(self) -> None:
        appliance = self.random.choice([self.appliance, *self.appliances])
        self.say(f"{appliance.address} crashes")
        appliance.crash()

    def link_is_cut(self) -> None:
        pair = frozenset(self.random.sample([*ADDRESSES.values(), WITNESS], 2))
        self.network.cut ^= {pair}
        self.say(f"{sorted(pair)} {'are cut off' if pair in self.network.cut else 'reach each other'}")

    def is_cut_off(self) -> None:
        host = self.random.choice([node.host for node in self.nodes] or [WITNESS])
        if host != WITNESS:
            pairs = {frozenset((host, address)) for address in ADDRESSES.values()}
            self.network.cut ^= pairs
            self.say(f"{host} {'is cut off' if pairs <= self.network.cut else 'reaches the appliances'}")

    def switches_over(self) -> None:
        self.say("a switchover is ordered")
        self.loop.outside.start(self.order(standby_requests.StandbyPromote()))

    def lease_stalls(self) -> None:
        seconds = self.random.choice(_STALL_SECONDS)
        self.say(f"the lease of {self.appliance.address} is paused for {seconds} s")
        self.appliance.pause_lease(seconds)

    def witness_ends(self) -> None:
        self.say("the witness starts again")
        self.robot.restart()
