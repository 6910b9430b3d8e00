import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from appliance.base.withdrawal import WithdrawnError, withdrawable
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.specifications.compiled_store import CompiledStore
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_files import Sources, SpecificationsRefusedError
from tests.support.memory_channel import memory_link

SOURCES = Sources({"a.rv": "text"})
FOUND = messages.Contents({"a": "a.rv"})

pytestmark = pytest.mark.anyio


class Scene:
    def __init__(self, *acts: Callable[[Channel, Any], None], store: CompiledStore | None = None) -> None:
        self.calls = 0
        self._acts = list(acts)
        self._channels: list[Channel] = []
        self.compiler = SpecificationCompiler(self.called, store)

    def called(self) -> None:
        self.calls += 1
        asyncio.get_running_loop().call_soon(self.come)

    def come(self) -> None:
        ours, channel = memory_link(messages.CompilerLink)
        self._channels.append(channel)
        channel.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: self._acts.pop(0)(channel, message),
            channel.close,
        )
        self.compiler.attach(ours)

    def close(self) -> None:
        for channel in self._channels:
            channel.close()


def finds(channel: Channel, wanted: messages.ContentsWanted) -> None:
    channel.send(messages.ContentsFound(wanted.number, FOUND))


def refuses(channel: Channel, wanted: messages.ContentsWanted) -> None:
    channel.send(messages.CompilationRefused(wanted.number, ["a.rv:1:1: error: no"]))


def dies(channel: Channel, _wanted: messages.ContentsWanted) -> None:
    channel.close()


async def test_the_compiler_is_started_for_the_first_question() -> None:
    scene = Scene(finds, refuses, finds)
    assert (await scene.compiler.check(Sources(), ())).monitors == {}
    assert scene.calls == 0
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    with pytest.raises(SpecificationsRefusedError, match=r"a\.rv:1:1: error: no"):
        await scene.compiler.check(SOURCES, ())
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    assert scene.calls == 1
    scene.close()


async def test_a_compiler_that_just_ended_is_replaced() -> None:
    scene = Scene(dies, finds)
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    assert scene.calls == 2
    scene.close()


async def test_only_texts_that_crash_it_are_refused() -> None:
    scene = Scene(dies, dies, finds)
    with pytest.raises(SpecificationsRefusedError, match="the compiler exited while it read them"):
        await scene.compiler.check(SOURCES, ())
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    scene.close()


async def test_a_silent_or_missing_compiler_is_not_waited_for() -> None:
    scene = Scene(lambda _channel, _wanted: None)
    with pytest.raises(SpecificationsRefusedError, match="the compiler does not answer"):
        await scene.compiler.check(SOURCES, ())
    scene.close()
    nobody: list[None] = []
    alone = SpecificationCompiler(lambda: nobody.append(None))
    for _ in range(2):
        with pytest.raises(SpecificationsRefusedError, match="the compiler does not answer"):
            await alone.check(SOURCES, ())
    assert len(nobody) == 2


class Told:
    def __init__(self) -> None:
        self.heard: asyncio.Queue[Any] = asyncio.Queue()

    def __call__(self, channel: Channel, wanted: Any) -> None:
        self.heard.put_nowait(wanted)
        if not wanted.dry_run:
            finds(channel, wanted)


async def test_an_order_ends_a_dry_run() -> None:
    told = Told()
    scene = Scene(told, told)
    dry_run = asyncio.ensure_future(scene.compiler.try_out(SOURCES, ()))
    assert (await told.heard.get()).dry_run
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    with pytest.raises(SpecificationsRefusedError, match="stopped, because a change needed the compiler"):
        await dry_run
    assert scene.calls == 2
    scene.close()


async def test_a_dry_run_begins_after_earlier_orders_and_dry_runs() -> None:
    heard: list[tuple[Channel, Any]] = []
    scene = Scene(*[lambda channel, wanted: heard.append((channel, wanted))] * 3)

    async def until(count: int) -> None:
        async with asyncio.timeout(20):
            while len(heard) < count:
                await asyncio.sleep(0)

    order = asyncio.ensure_future(scene.compiler.check(SOURCES, ()))
    await until(1)
    dry_runs = [asyncio.ensure_future(scene.compiler.try_out(SOURCES, ())) for _ in range(2)]
    for count in (1, 2, 3):
        await until(count)
        for _ in range(20):
            await asyncio.sleep(0)
        assert len(heard) == count
        finds(*heard[-1])
    assert [found.monitors for found in await asyncio.gather(order, *dry_runs)] == [{"a": "a.rv"}] * 3
    assert [wanted.dry_run for _channel, wanted in heard] == [False, True, True]
    scene.close()


async def test_a_compilation_ends_when_its_order_is_withdrawn() -> None:
    heard: asyncio.Queue[Any] = asyncio.Queue()
    scene = Scene(lambda _channel, wanted: heard.put_nowait(wanted), finds)
    gone = False

    async def order() -> None:
        with withdrawable(lambda: gone):
            await scene.compiler.check(SOURCES, ())

    withdrawn = asyncio.ensure_future(order())
    await heard.get()
    gone = True
    with pytest.raises(WithdrawnError):
        await withdrawn
    assert (await scene.compiler.check(SOURCES, ())).monitors == {"a": "a.rv"}
    assert scene.calls == 2
    scene.close()


async def test_a_start_asks_nothing_that_an_earlier_one_asked(tmp_path: Path) -> None:
    store = CompiledStore(tmp_path / "compiled", "toolchain")
    first = Scene(finds, store=store)
    assert (await first.compiler.check_at_start(SOURCES, ())).monitors == {"a": "a.rv"}
    first.close()
    second = Scene(store=store)
    second.compiler.call_early()
    assert (await second.compiler.check_at_start(SOURCES, (), known=("w",))).warnings == ("w",)
    assert second.calls == 0
    changed = Scene(finds, store=store)
    await changed.compiler.check_at_start(Sources({"a.rv": "other"}), ())
    assert changed.calls == 1
    changed.close()
