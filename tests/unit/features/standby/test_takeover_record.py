from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import structlog

from appliance.audit.proof.copies import SignedCheckpoint, newest_checkpoint
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from tests.support.features.standby.appliance_pair import Member, World
from tests.support.waiting import until

pytestmark = pytest.mark.anyio


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
async def a(tmp_path: Path, world: World) -> AsyncIterator[Member]:
    member = Member(tmp_path / "a", "a", "b", world)
    member.open()
    yield member
    member.close()


@pytest.fixture
async def b(tmp_path: Path, world: World) -> AsyncIterator[Member]:
    member = Member(tmp_path / "b", "b", "a", world, ahead=3600)
    member.open()
    yield member
    member.close()


def records(member: Member, event: str) -> list[dict[str, Any]]:
    found = search(member.path, Filter(event=event), newest_first=False).entries
    return [{**one.record.detail, "reason": one.record.reason} for one in found]


async def sealed_by_b(a: Member, b: Member) -> SignedCheckpoint:
    async with b.active(1):
        await b.decide(3, 1)
        await b.sealed()
    b.replicate_to(a)
    checkpoint = b.replicated()
    assert checkpoint is not None
    return checkpoint


async def test_a_takeover_names_the_last_replicated_checkpoint(a: Member, b: Member) -> None:
    named = await sealed_by_b(a, b)
    await a.recorder.took_over(4)
    (record,) = records(a, "took over")
    assert record.pop("reason").startswith(
        "a is active from epoch 4; the last replicated checkpoint of b is "
    )
    assert record == {
        "epoch": 4,
        "appliance": "a",
        "other": "b",
        "checkpoint": msgspec.to_builtins(named),
        "previous": {"epoch": 1, "appliance": "b"},
    }
    assert named.key == b.key.public_key().public_bytes_raw().hex()


async def test_the_first_takeover_says_that_no_checkpoint_was_replicated(a: Member) -> None:
    await a.recorder.took_over(1)
    (record,) = records(a, "took over")
    assert (record["checkpoint"], record["previous"]) == (None, None)
    assert record["reason"] == "a is active from epoch 1; no checkpoint of b was replicated"


async def test_a_checkpoint_of_its_own_log_is_not_named(a: Member) -> None:
    async with a.active(1):
        await a.sealed()
    own = a.replicated()
    assert own is not None
    a.store.save_setting("audit checkpoint of b", own.as_json())
    await a.recorder.took_over(2)
    record = records(a, "took over")[1]
    assert record["checkpoint"] is None
    assert record["reason"].endswith("the replicated checkpoint of b is of this appliance's own log")


@pytest.mark.parametrize(
    ("written", "forged"),
    [
        ('"sequence":', '"sequence":1'), ('"number":', '"number":1'),
        ('"number":', '"number":99999999999999999999'), ('"number":', '"number":-'), ('"log":"', '"log":"x'),
        ('"hash":"', '"hash":"0'), ('"signature":"', '"signature":"00'), ('"signature":"', '"signature":"x'),
        ('"key":"', '"key":"00'), ("{", "["),
    ],
)  # fmt: skip
async def test_a_lying_appliance_gets_no_checkpoint_named(
    a: Member, b: Member, written: str, forged: str
) -> None:
    text = (await sealed_by_b(a, b)).as_json()
    a.store.save_setting("audit checkpoint of b", text.replace(written, forged, 1))
    await a.recorder.took_over(2)
    (record,) = records(a, "took over")
    assert record["checkpoint"] is None
    assert "the replicated checkpoint of b is not valid: " in record["reason"]


@pytest.mark.parametrize(
    "text", ["", "{", "[" * 100_000, '"\\ud800"', "null", '{"epoch": -1, "appliance": "b"}']
)
async def test_a_state_without_a_last_takeover_has_no_previous_one(a: Member, text: str) -> None:
    a.store.save_setting("last takeover", text)
    await a.recorder.took_over(1)
    assert records(a, "took over")[0]["previous"] is None


async def test_a_restart_within_an_epoch_repeats_no_record(a: Member) -> None:
    for epoch in (1, 1, 2, 2):
        await a.recorder.took_over(epoch)
    assert [record["epoch"] for record in records(a, "took over")] == [1, 2]


async def test_the_own_log_knows_the_takeover_before(a: Member) -> None:
    """A crash may have come before the state had the last takeover."""
    await a.recorder.took_over(5)
    a.store.save_setting("last takeover", '{"epoch": 3, "appliance": "b"}')
    await a.recorder.took_over(6)
    assert records(a, "took over")[1]["previous"] == {"epoch": 5, "appliance": "a"}


async def test_the_state_has_a_takeover_only_once_its_record_is_on_disk(a: Member) -> None:
    a.path.rename(a.path.with_name("away"))
    await a.recorder.took_over(1)
    assert "last takeover" not in a.store.settings()
    a.path.with_name("away").rename(a.path)
    assert await a.log.wait_durable() is None
    await a.recorder.took_over(1)
    assert a.store.settings()["last takeover"] == '{"epoch":1,"appliance":"a"}'
    assert [record["epoch"] for record in records(a, "took over")] == [1]


async def test_the_takeover_is_sealed_and_replicated_at_once(a: Member) -> None:
    async with a.active(1, sealed=False):
        ((place),) = [entry.sequence for entry in search(a.path, Filter(event="took over")).entries]
        await until(lambda: (kept := a.replicated()) and kept.sequence >= place)


async def test_each_signed_checkpoint_is_replicated(a: Member) -> None:
    async with a.active(1):
        for _ in range(3):
            await a.decide(2, 1)
            await a.sealed()  # waits for it


async def test_an_earlier_checkpoint_is_replicated_at_the_start(a: Member) -> None:
    await a.decide(2, 1)
    assert await a.log.wait_signed() is None
    first = newest_checkpoint(a.path)
    assert first is not None
    a.silence()
    async with a.active(1, sealed=False):
        await until(lambda: a.replicated() == first)
    assert newest_checkpoint(a.path) == first  # those after it have no signature


async def test_a_hand_over_returns_when_the_state_has_the_sealed_log(a: Member) -> None:
    async with a.active(1):
        await a.decide(2, 1)
    await a.hand_over(1)
    (place,) = [entry.sequence for entry in search(a.path, Filter(event="handed over")).entries]
    kept = a.replicated()
    assert kept is not None
    assert kept.sequence >= place
    (record,) = records(a, "handed over")
    assert record == {"epoch": 1, "appliance": "a", "to": "b", "reason": "a handed over to b in epoch 1"}


async def test_a_log_that_cannot_be_read_does_not_end_the_replication(a: Member) -> None:
    async with a.active(1):
        with structlog.testing.capture_logs() as printed:
            a.path.rename(a.path.with_name("away"))
            a.signed.set()
            await until(lambda: [one for one in printed if "not replicated" in one["event"]])
            a.path.with_name("away").rename(a.path)
        await until(lambda: a.log.failed is None)
        await a.decide(2, 1)
        await a.sealed()


async def test_an_older_checkpoint_replaces_no_newer_one(a: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    async with a.active(1):
        older = a.replicated()
        await a.decide(2, 1)
        await a.sealed()
    newer = a.replicated()
    assert older is not None
    assert newer is not None
    monkeypatch.setattr("appliance.features.standby.service_begin.newest_checkpoint", lambda _path: older)
    await a.hand_over(1)
    assert a.replicated() == newer
