"""The exclusive right to answer: the lease, control's replication and the witness, with messages in all orders."""

import asyncio
import contextlib
from collections import deque
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from appliance.base import clock
from appliance.channel import messages
from appliance.features.standby import lease_link, replication
from appliance.features.standby.lease_client import LeaseClient
from appliance.features.standby.process import LeaseProcess
from appliance.features.standby.replication import Replication
from appliance.features.standby.replication_frames import Stored
from appliance.features.standby.replication_sender import ReplicationLag
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import EXPIRY
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import AppliancePeer
from tests.support.examples import examples
from tests.support.memory_channel import memory_link
from tests.support.virtual_clock import VirtualClock
from tests.unit.features.standby.parts import MEMBERSHIP, CountedDatabase

ADDRESSES = {"a": "10.0.0.2", "b": "10.0.0.3"}
KEYS = {"a": b"\xaa" * 32, "b": b"\xbb" * 32}
STEPS = (
    "change", "ship", "acknowledge", "connect", "disconnect", "time", "witness", "answer", "lose", "report",
    "to lease", "to control", "restart", "settle", "settle", "away", "back", "back",
)  # fmt: skip

STORIES = {
    "settle": ("time", "witness", "answer", "witness", "answer", "all to control", "report", "all to lease"),
    "away": ("disconnect", "change", "settle", "settle", "settle"),
    "back": ("connect", "ship", "acknowledge", "report", "to lease"),
}


class Datagrams:
    def __init__(self, sent: deque[bytes]) -> None:
        self._sent = sent

    def sendto(self, datagram: bytes, _to: tuple[str, int]) -> None:
        self._sent.append(datagram)


class Pair:
    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, machine: VirtualClock) -> None:
        self.machine = machine
        patch.setattr(replication, "replication_context", lambda *_, **__: None)
        record = LeaseRecord(1, "", ("a", "b"), "boot")
        self.witness = Witness(
            record=record, save=lambda _: None, admit=lambda _: None, boot="boot", clock=clock.since_boot
        )
        peers = {name: AppliancePeer(ADDRESSES[name], KEYS[name]) for name in ADDRESSES}
        self.gate = WitnessGate(self.witness, peers, "nonce")
        self.requests, self.answers = deque[bytes](), deque[bytes]()
        self.to_lease, self.to_control = deque[Any](), deque[Any]()
        lifeline, _supervisor = memory_link(messages.Lifeline)
        away: Any = Datagrams(deque())
        asking: Any = Datagrams(self.requests)
        self.lease = LeaseProcess(MEMBERSHIP, lifeline, folder / "epoch", peers=away, asking=asking)
        patch.setattr(self.lease.child, "tell", self.to_control.append)
        self.database = CountedDatabase()
        self.standby = 0  # the last change on the standby's disk
        self.acknowledgements = deque[int]()
        self.answered = 0
        self.waiting: set[asyncio.Task[None]] = set()
        self.control: Replication
        self.client: LeaseClient

    def start_control(self, *, taken_over: bool) -> None:
        for task in self.waiting:
            task.cancel()
        self.waiting.clear()
        self.to_lease.clear()
        self.to_control.clear()
        self.acknowledgements.clear()
        self.client = LeaseClient()
        client: Any = self.client
        client.send = self.to_lease.append
        self.control = Replication(
            MEMBERSHIP, self.client, self.database, 2, taken_over=taken_over, folder=Path()
        )
        self.lease.control_linked()
        self.control.begin()

    def step(self, name: str) -> None:
        """Do what has the name, if it can happen now, or all steps of a story."""
        for each in STORIES.get(name, ()):
            self.step(each)
        self._change(name)
        self._deliver(name)

    def _change(self, name: str) -> None:
        sender: Any = self.control.sender
        match name:
            case "change":
                self.waiting.add(asyncio.ensure_future(self._answer(self.database.change())))
            case "connect":
                sender.link = sender.link or asyncio.Future[None]()
            case "disconnect":
                sender.link = None
                self.acknowledgements.clear()
            case "ship" if sender.link is not None:
                self.standby = max(self.standby, self.database.number)
                sender.note_sent(self.standby)
                self.acknowledgements.append(self.standby)
            case "acknowledge" if self.acknowledgements:
                sender.take(Stored(2, self.database.history, self.acknowledgements.popleft()))
            case "restart":
                self.start_control(taken_over=False)

    def _deliver(self, name: str) -> None:
        match name:
            case "time":
                self.machine.advance(0.31)
                self.lease.tick()
            case "witness" if self.requests:
                answer = self.gate.answer(self.requests.popleft(), ADDRESSES["a"])
                assert answer is not None
                self.answers.append(answer)
            case "answer" if self.answers:
                self.lease.witness_sent(self.answers.popleft(), "10.0.0.1")
            case "lose" if self.answers:
                self.answers.popleft()
            case "report":
                self.control.report()
            case "to lease" | "all to lease" if self.to_lease:
                self.lease.control_said(self.to_lease.popleft())
                self.step(name if name == "all to lease" else "")
            case "to control" | "all to control" if self.to_control:
                message = self.to_control.popleft()
                if isinstance(message, lease_link.LeaseState):
                    self.client.heard(message)
                self.step(name if name == "all to control" else "")

    async def _answer(self, number: int) -> None:
        await self.control.until_stored()
        self.answered = max(self.answered, number)

    async def turn(self) -> None:
        for _ in range(3):
            await asyncio.sleep(0)
        if "b" in self.in_sync():
            assert self.answered <= self.standby, f"change {self.answered} is answered, b has {self.standby}"

    def in_sync(self) -> set[str]:
        assert self.witness.record is not None
        return set(self.witness.record.in_sync)

    def close(self) -> None:
        for task in self.waiting:
            task.cancel()


async def run(pair: Pair, steps: list[str]) -> None:
    pair.machine.advance(EXPIRY)
    pair.start_control(taken_over=True)
    for step in ["settle"] * 8 + steps:
        pair.step(step)
        await pair.turn()


# Control restarts after the order to add the standby: it must not learn an earlier permission again.
@example(
    steps=[
        "change", "change", "time", "witness", "back", "settle", "restart", "change", "answer", "to control",
    ]
)  # fmt: skip
@settings(max_examples=examples(600))
@given(st.lists(st.sampled_from(STEPS), min_size=10, max_size=60))
def test_a_change_answered_alone_is_not_missing_on_a_standby_in_sync(
    tmp_path_factory: pytest.TempPathFactory, steps: list[str]
) -> None:
    machine = VirtualClock()
    with pytest.MonkeyPatch.context() as patch, clock.using(machine):
        pair = Pair(tmp_path_factory.mktemp("pair"), patch, machine)
        try:
            asyncio.run(run(pair, steps))
        finally:
            pair.close()


def test_it_answers_alone_and_waits_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = VirtualClock()

    async def story() -> None:
        await run(pair, ["change", *["settle"] * 8])
        assert pair.answered == 1
        assert pair.in_sync() == {"a"}
        for step in ("connect", "ship", "acknowledge", *["settle"] * 8):
            pair.step(step)
            await pair.turn()
        assert pair.in_sync() == {"a", "b"}
        pair.step("change")
        await pair.turn()
        assert pair.answered == 1, "it waits for the standby again"
        for step in ("ship", "acknowledge"):
            pair.step(step)
        await pair.turn()
        assert pair.answered == 2

    with clock.using(machine), contextlib.closing(Pair(tmp_path, monkeypatch, machine)) as pair:
        asyncio.run(story())


def test_a_report_under_an_earlier_permission_adds_no_standby(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The standby had all data before the removal; control answers without it as soon as it hears of the removal."""
    machine = VirtualClock()
    caught_up = ("back", "all to lease")

    async def story() -> None:
        await run(pair, ["connect", "change", *caught_up, *["settle"] * 8, "change"])
        assert pair.in_sync() == {"a", "b"} and pair.answered == 1
        for step in ("report", "all to lease", *["time"] * 3, *caught_up):
            pair.step(step)
        await pair.turn()
        for step in ("witness", "answer") * 8:
            pair.step(step)
        assert pair.in_sync() == {"a"}, "the removal was on its way"
        for step in ("time", *("witness", "answer") * 8):
            pair.step(step)
        assert pair.in_sync() == {"a"}
        for step in ["settle", *caught_up] * 3:
            pair.step(step)
            await pair.turn()
        assert pair.in_sync() == {"a", "b"}

    with clock.using(machine), contextlib.closing(Pair(tmp_path, monkeypatch, machine)) as pair:
        asyncio.run(story())


def test_a_standby_has_the_time_that_a_large_value_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wait for a large value is reported with a later beginning: a standby also needs time to store it."""

    async def waits(size: int) -> float:
        pair.start_control(taken_over=False)
        now = asyncio.get_running_loop().time()
        sender: Any = pair.control.sender
        sender.lag = lambda: ReplicationLag(True, 1, size, now, "")
        pair.control.report()
        return float(clock.since_boot() - pair.to_lease[-1].waiting_since)

    machine = VirtualClock()
    with clock.using(machine), contextlib.closing(Pair(tmp_path, monkeypatch, machine)) as pair:
        assert asyncio.run(waits(100)) == pytest.approx(0.0, abs=1e-3)
        assert asyncio.run(waits(30 << 20)) == pytest.approx(-1.5, abs=1e-3)
