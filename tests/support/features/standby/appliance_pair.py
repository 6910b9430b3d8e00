import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractContextManager, asynccontextmanager
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.proof.copies import SignedCheckpoint, newest_checkpoint
from appliance.base.clock import now, using
from appliance.channel import messages
from appliance.control.links.signer_requests import SignerRequests
from appliance.features.standby.service_begin import TakeoverRecorder
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.audit import decision
from tests.support.autojump import run
from tests.support.engines import InlineDatabase, open_log
from tests.support.memory_channel import memory_link
from tests.support.virtual_clock import VirtualClock

SECOND = 1_000_000_000
BEGAN = 1_767_225_600 * SECOND  # 2026-01-01T00:00:00Z


class World:
    def __init__(self) -> None:
        self.now = BEGAN

    def passes(self, seconds: float) -> None:
        self.now += int(seconds * SECOND)


class Member:
    def __init__(self, state: Path, name: str, other: str, world: World, *, ahead: float = 0) -> None:
        self.state, self.name, self.other = state, name, other
        self.key = Ed25519PrivateKey.generate()
        self.ahead = ahead
        self._world = world
        (state / "control").mkdir(parents=True)
        self.path = state / "control" / "audit.db"

    def clock(self) -> int:
        return self._world.now + int(self.ahead * SECOND)

    def open(self) -> None:
        requests = SignerRequests(lambda: self.log)
        self.signed, self._signs = requests.signed, True
        self.log = open_log(
            self.path,
            signer=requests.want,
            clock=self.clock,
            checkpoint_every=1_000_000,
            checkpoint_seconds=1e6,
        )
        ours, self._signer = memory_link(messages.SignerLink)
        self._signer.attach(asyncio.get_running_loop(), self._sign, lambda: None, lambda _reason: None)
        requests.attach(ours)
        self._requests = requests
        self.store = StateStore(self.state / "control", failed=lambda _reason: None, kind=InlineDatabase)
        trail = AuditTrail(self.log, strict=False, deny_when_failed=False)
        self.trail = trail
        self.recorder = TakeoverRecorder(
            trail, self.log, self.store, self.signed, name=self.name, other=self.other
        )

    def _sign(self, message: object, _descriptors: tuple[int, ...]) -> None:
        if isinstance(message, messages.SignatureWanted) and self._signs:
            public = self.key.public_key().public_bytes_raw()
            self._signer.send(messages.SignatureMade(message.number, self.key.sign(message.text), public))

    def silence(self) -> None:
        self._signs = False

    def close(self) -> None:
        self.silence()
        assert self.log.close() is None
        self.store.close()
        self._requests.link.close()
        self._signer.close()

    @asynccontextmanager
    async def active(self, epoch: int, *, sealed: bool = True) -> AsyncIterator[None]:
        with self.timed():
            await self.recorder.took_over(epoch)
        following = asyncio.create_task(self.recorder.follow())
        try:
            if sealed:
                await self.sealed()
            yield
        finally:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)

    def timed(self) -> AbstractContextManager[None]:
        return using(VirtualClock(wall=self.clock() / SECOND, now=now()))

    async def decide(self, count: int, seconds: float) -> None:
        for number in range(count):
            self._world.passes(seconds / count)
            self.log.record(decision(self.log, number, time=self.clock()))
        assert await self.log.wait_durable() is None

    async def sealed(self) -> None:
        assert await self.log.wait_signed() is None
        newest = newest_checkpoint(self.path)
        while self.replicated() != newest:
            await asyncio.sleep(0.01)

    def replicated(self) -> SignedCheckpoint | None:
        text = self.store.settings().get(f"audit checkpoint of {self.name}")
        return None if text is None else msgspec.json.decode(text, type=SignedCheckpoint)

    def replicate_to(self, other: "Member") -> None:
        for name, value in self.store.settings().items():
            other.store.save_setting(name, value)

    async def hand_over(self, epoch: int) -> None:
        with self.timed():
            await asyncio.wait_for(self.recorder.handed_over(epoch), 60)


Story = Callable[[Member, Member, World], Awaitable[None]]


def play(folder: Path, story: Story) -> tuple[Member, Member]:
    world = World()
    a = Member(folder / "a", "a", "b", world)
    b = Member(folder / "b", "b", "a", world, ahead=3600)

    async def tell() -> None:
        a.open()
        b.open()
        try:
            await story(a, b, world)
        finally:
            a.close()
            b.close()

    run(tell())
    return a, b


async def four_takeovers(a: Member, b: Member, world: World) -> None:
    async with a.active(1):
        await a.decide(10, 100)
        await a.sealed()
        a.replicate_to(b)
        await a.decide(5, 2)
    world.passes(3)
    async with b.active(2):
        await b.decide(10, 100)
    await b.hand_over(2)
    b.replicate_to(a)
    world.passes(1)
    async with a.active(4):
        await a.decide(10, 100)
        await a.sealed()
        a.replicate_to(b)
        await a.decide(5, 2)
    world.passes(3)
    async with b.active(5):
        await b.decide(10, 100)
        await b.sealed()
