import asyncio
import socket
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from appliance.audit.log.ids import IdSource
from appliance.audit.log.record import Severity
from appliance.base.clock import wall_ns
from appliance.channel import messages
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.channel import Channel
from appliance.control.errors import SenselessError, UnavailableError, UnknownThingError
from appliance.features.recorder import recorder_link
from appliance.features.recorder import requests as recording_requests
from appliance.features.recorder.orders import RecordingOrders
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Trigger
from appliance.features.recorder.recording_plan import RecordingPlan
from appliance.features.recorder.recording_store import MAX_TEMPORARY
from appliance.features.recorder.settings import RecorderRules
from appliance.features.recorder.view import RecorderState
from tests.support.core import FakeTrail
from tests.support.memory_channel import memory_link

pytestmark = pytest.mark.anyio

KEPT = Recording(
    "a" * 20, 1, 2, [Trigger(1, "drop", "r", "t")], [], 1, 1, 300, "5a", complete=True, why_not=""
)


class Scene:
    def __init__(self, **rules: Any) -> None:
        self.trail = FakeTrail()
        own = RecorderRules(**{"enabled": True} | rules)
        self.plan = RecordingPlan(own, lambda host: host, IdSource().next)
        self.orders = RecordingOrders(own, self.trail, lambda: (4, 2), self.plan, "/guardian")

    @property
    def state(self) -> RecorderState:
        state = self.orders.state()
        assert state is not None
        return state

    def attach(self, answer: Callable[[Any], list[messages.Message]]) -> Channel:
        ours, theirs = socket.socketpair()
        self.orders.link.attach(Channel(ours, recorder_link.RecorderLink))
        recorder = Channel(theirs, recorder_link.RecorderLink)

        def received(message: Any, _descriptors: tuple[int, ...]) -> None:
            for said in answer(message):
                recorder.send(said)

        recorder.attach(asyncio.get_running_loop(), received, lambda: None)
        return recorder


@pytest.fixture
def scene() -> Scene:
    return Scene()


async def told(scene: Scene, done: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not done():
            await asyncio.sleep(0)


async def test_a_missing_recorder_is_reported() -> None:
    off = Scene(enabled=False)
    assert off.orders.state() is None
    assert off.orders.limits() == ()
    with pytest.raises(UnknownThingError, match="enabled: true"):
        await off.orders.recordings(recording_requests.RecordingsWanted())
    away = Scene()
    state = away.orders.state()
    assert state is not None
    assert not state.running
    with pytest.raises(UnavailableError, match="is not running now"):
        await away.orders.now(recording_requests.RecordNow(), "eve")


@pytest.mark.nightly
async def test_a_call_of_the_service_is_an_order() -> None:
    heard: list[Any] = []
    call = messages.OwnServiceCalled(7, "/rosrv/record_now", "10.0.0.5", "/arm")

    def answer(message: Any) -> list[messages.Message]:
        heard.append(message)
        if len(heard) == 1:
            return [recorder_link.RecordingStarted(message.number, KEPT.id, 5)]
        return [recorder_link.RecordingRefused(message.number, "this hour has its 6")]

    scene = Scene()
    away = await scene.orders.called(call)
    assert (away.success, away.text) == (False, "the flight recorder is not running now: see rosrv status")
    assert scene.trail.events == []
    recorder = scene.attach(answer)
    assert await scene.orders.called(call) == messages.OwnServiceAnswered(7, True, KEPT.id)
    assert await scene.orders.called(call) == messages.OwnServiceAnswered(7, False, "this hour has its 6")
    [row, _again] = scene.trail.rows
    assert row["event"] == "recording ordered"
    assert (row["host"], row["caller_id"], row["resource"]) == ("10.0.0.5", "/arm", call.service)
    wanted = heard[0]
    assert (wanted.trigger.what, wanted.trigger.record) == ("service", row["id"])
    assert wanted.trigger.text == "/arm of 10.0.0.5 called /rosrv/record_now"
    assert (wanted.before, wanted.after) == (60, 10)
    recorder.close()


@pytest.mark.nightly
async def test_a_closed_recording_is_recorded_and_listed() -> None:
    heard: list[Any] = []
    scene = Scene()

    def hear(message: Any) -> list[messages.Message]:
        heard.append(message)
        return []

    recorder = scene.attach(hear)
    recorder.send(recorder_link.RevisionsWanted())
    recorder.send(recorder_link.RecordingClosed(KEPT))
    await told(scene, lambda: len(heard) == 2)
    assert heard == [recorder_link.RevisionsStated(4, 2), recorder_link.RecordingNoted(KEPT.id)]
    known = await scene.orders.recordings(recording_requests.RecordingsWanted())
    assert (known.recordings, known.publish_as) == ([KEPT], "/guardian")
    assert await scene.orders.recording(recording_requests.RecordingWanted(KEPT.id)) == KEPT
    [row] = scene.trail.rows
    assert (row["event"], row["recording"], row["sha256"]) == ("recording closed", KEPT.id, "5a")
    assert row["triggers"] == ["drop r"]
    recorder.send(recorder_link.RecordingRemoved(0, KEPT, "", "recorder.disk is full"))
    await told(scene, lambda: len(scene.trail.events) == 2)
    assert scene.trail.rows[1]["who"] == "recorder"
    await told(scene, lambda: len(heard) == 3)
    assert heard[2] == recorder_link.RecordingNoted(KEPT.id)
    scene.trail.log.failure = "no space left on device"
    recorder.send(recorder_link.RecordingClosed(KEPT))
    recorder.send(recorder_link.RevisionsWanted())
    await told(scene, lambda: len(heard) == 4)
    assert heard[3] == recorder_link.RevisionsStated(
        4, 2
    )  # a recording that is not on disk is reported again
    with pytest.raises(UnavailableError, match="cannot be recorded: no space left"):
        await scene.orders.fetch(recording_requests.RecordingFetch(KEPT.id), "eve")
    with pytest.raises(UnknownThingError, match="no recording"):
        await scene.orders.fetch(recording_requests.RecordingFetch("other"), "eve")
    recorder.close()


async def test_a_record_after_a_missed_one_names_what_is_made_instead(scene: Scene) -> None:
    ours, recorder = memory_link(recorder_link.RecorderLink)
    scene.orders.link.attach(ours)

    def planned() -> dict[str, str]:
        now = wall_ns()
        return scene.plan.detail("stop begun", None, Severity.WARNING, None, now)

    trigger = Trigger(wall_ns(), "stop", "r", "t")
    making = OpenRecording(KEPT.id, trigger.time, trigger.time + 10**10, trigger)
    unmade = planned()["recording"]
    recorder.send(recorder_link.RecordingMissed(trigger, "it prolonged another", unmade, making))
    await told(scene, lambda: bool(scene.trail.events))
    [row] = scene.trail.rows
    found = [row[name] for name in ("event", "recording", "reason")]
    assert found == ["recording missed", unmade, "it prolonged another"]
    assert planned()["recording"] == KEPT.id


@pytest.mark.parametrize(
    ("before", "after"), [(601, None), (None, 0), (600, 10), (591, None), (None, 541), (540, 300), (-1, None)]
)
async def test_an_order_for_more_than_the_longest_recording_is_rejected(
    scene: Scene, before: float | None, after: float | None
) -> None:
    ours, _recorder = memory_link(recorder_link.RecorderLink)
    scene.orders.link.attach(ours)
    with pytest.raises(SenselessError, match=r"both together at most 600 \(recorder.longest\)"):
        await scene.orders.now(recording_requests.RecordNow(before, after), "eve")
    assert not scene.trail.events


@pytest.mark.nightly
async def test_orders_have_the_name_of_their_operator() -> None:
    scene = Scene()

    def answer(message: Any) -> list[messages.Message]:
        match message:
            case recorder_link.RecordingRequested(number, trigger, before, after):
                [row] = scene.trail.rows
                assert (trigger.record, trigger.text, before, after) == (row["id"], "eve: why", 60, 5)
                return [recorder_link.RecordingStarted(number, KEPT.id, 9)]
            case recorder_link.RecordingRemovalWanted(number, recording_id, who):
                if recording_id != KEPT.id:
                    return [recorder_link.RecordingRefused(number, "there is none", unknown=True)]
                return [recorder_link.RecordingRemoved(number, KEPT, who, "")]
        return []

    recorder = scene.attach(answer)
    begun = await scene.orders.now(recording_requests.RecordNow(after=5, note="why"), "eve")
    assert (begun.id, begun.ends) == (KEPT.id, 9)
    assert scene.trail.rows[0]["who"] == "eve"
    with pytest.raises(UnknownThingError, match="still being made"):
        await scene.orders.fetch(recording_requests.RecordingFetch(KEPT.id), "eve")
    with pytest.raises(UnknownThingError, match="no recording"):
        await scene.orders.fetch(recording_requests.RecordingFetch(""), "eve")
    assert await scene.orders.remove(recording_requests.RecordingRemove(KEPT.id), "eve") == KEPT
    assert scene.trail.rows[1]["who"] == "eve"
    with pytest.raises(UnknownThingError):
        await scene.orders.remove(recording_requests.RecordingRemove("b" * 20), "eve")
    recorder.close()


@pytest.mark.parametrize("reason", ["", "recorder.disk is full"])
@pytest.mark.parametrize("by", ["", "eve", "dave"])
async def test_only_an_order_puts_the_name_of_an_operator_into_the_log(
    scene: Scene, by: str, reason: str
) -> None:
    """The recorder may be compromised. An order that it answers too late, or again, still has its name."""
    ours, recorder = memory_link(recorder_link.RecorderLink)
    scene.orders.link.attach(ours)
    removed = [recorder_link.RecordingRemoved(number, KEPT, "eve", reason) for number in (0, 1, 7)]
    if by:
        ordered = asyncio.ensure_future(scene.orders.remove(recording_requests.RecordingRemove(KEPT.id), by))
        await asyncio.sleep(0)
        ordered.cancel()
    for message in removed:
        recorder.send(message)
    await told(scene, lambda: len(scene.trail.rows) == 3)
    expected = "recorder" if reason or not by else by
    assert {row["who"] for row in scene.trail.rows} == {expected}


async def test_an_open_recording_is_listed(scene: Scene) -> None:
    ours, recorder = memory_link(recorder_link.RecorderLink)
    scene.orders.link.attach(ours)
    opened = OpenRecording(KEPT.id, 1_000, 5 * 10**9, Trigger(1_000, "drop", "record", "so"))
    recorder.send(recorder_link.RecordingsStated([], [opened]))
    await told(scene, lambda: bool(scene.state.in_progress))
    assert (await scene.orders.recordings(recording_requests.RecordingsWanted())).in_progress == [opened]
    with pytest.raises(UnknownThingError, match="still being made: ask again after 1970-01-01T00:00:05"):
        await scene.orders.recording(recording_requests.RecordingWanted(KEPT.id))
    recorder.send(recorder_link.RecordingClosed(KEPT))
    await told(scene, lambda: not scene.state.in_progress)
    assert await scene.orders.recording(recording_requests.RecordingWanted(KEPT.id)) == KEPT


@pytest.mark.nightly
async def test_a_fetch_needs_a_record(scene: Scene) -> None:
    recorder = scene.attach(lambda _message: [])
    recorder.send(recorder_link.RecordingsStated([KEPT]))
    await told(scene, lambda: bool(scene.state.recordings))
    assert scene.orders.limits() == (LimitUse("bytes of recordings", KEPT.size, 2 << 30, "recorder.disk"),)
    assert await scene.orders.fetch(recording_requests.RecordingFetch(KEPT.id), "eve") == KEPT
    scene.trail.log.failure = "the disk is full"
    with pytest.raises(UnavailableError, match="cannot be recorded"):
        await scene.orders.fetch(recording_requests.RecordingFetch(KEPT.id), "eve")
    recorder.close()


@pytest.mark.nightly
async def test_an_order_to_a_dying_recorder_fails_at_once(scene: Scene) -> None:
    recorder = scene.attach(lambda _message: [])
    asked = asyncio.ensure_future(scene.orders.now(recording_requests.RecordNow(), "eve"))
    await told(scene, lambda: bool(scene.trail.events))
    recorder.close()
    with pytest.raises(UnavailableError, match="before it answered"):
        await asyncio.wait_for(asked, 5)


@pytest.mark.nightly
async def test_the_memory_can_be_fetched_and_is_not_listed() -> None:
    scene = Scene()
    lent = iter([msgspec.structs.replace(KEPT, id=letter * 20) for letter in "bcdef"])

    def answer(message: Any) -> list[messages.Message]:
        if not isinstance(message, recorder_link.MemoryWanted):
            return []
        assert (message.since, message.until > 0) == (7, True)
        assert message.trigger.record == scene.trail.records[-1].id
        return [recorder_link.MemoryLent(message.number, next(lent))]

    recorder = scene.attach(answer)
    first = await scene.orders.of_memory(recording_requests.RecordingOfMemory(since=7), "eve")
    assert await scene.orders.fetch(recording_requests.RecordingFetch(first.id), "eve") == first
    assert [(row["event"], row["who"]) for row in scene.trail.rows] == [
        ("recording ordered", "eve"),
        ("recording fetched", "eve"),
    ]
    known = await scene.orders.recordings(recording_requests.RecordingsWanted())
    assert (known.recordings, known.topics, known.before) == ([], ["/*"], 60)
    for _other in range(MAX_TEMPORARY):
        assert await scene.orders.fetch(recording_requests.RecordingFetch(first.id), "eve") == first
        await scene.orders.of_memory(recording_requests.RecordingOfMemory(since=7), "eve")
    with pytest.raises(UnknownThingError):
        await scene.orders.fetch(recording_requests.RecordingFetch(first.id), "eve")
    recorder.close()


@pytest.mark.nightly
async def test_more_topics_than_a_record_can_name_are_rejected(scene: Scene) -> None:
    recorder = scene.attach(lambda _message: [])
    recorder.send(recorder_link.RecordingsStated([KEPT]))
    await told(scene, lambda: bool(scene.state.recordings))
    for topics in ([f"/t{number}" for number in range(21)], ["/" + "t" * 500]):
        with pytest.raises(SenselessError, match="at most 20 topics"):
            await scene.orders.read(recording_requests.RecordingRead(KEPT.id, topics), "eve")
    assert not scene.trail.events
    longest = "/" + "t" * 499
    await scene.orders.read(recording_requests.RecordingRead(KEPT.id, [longest]), "eve")
    assert scene.trail.rows[0]["topics"] == [longest]
    recorder.close()
