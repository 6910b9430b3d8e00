"""A question that is asked again has the answer, the decision and the record that it would have had anew."""

import random
from collections.abc import Callable
from typing import Any

import pytest

from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.repeated_calls import Repetitions
from appliance.master.graph.registry import Kind
from appliance.rpc.server import HttpRequest
from roswire.xmlrpc import Value
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
QUESTIONS: list[tuple[str, tuple[Value, ...]]] = [
    ("getParam", ("/ear", "/arm/max")),
    ("getParam", ("/ear", "/arm")),
    ("hasParam", ("/ear", "/arm/min")),
    ("getParam", ("/guest", "/arm/max")),
    ("lookupNode", ("/ear", "/talker")),
    ("getSystemState", ("/ear",)),
    ("getPublishedTopics", ("/ear", "")),
    ("getTopicTypes", ("/ear",)),
    (
        "system.multicall",
        (
            [
                {"methodName": "getParam", "params": ["/ear", "/arm/max"]},
                {"methodName": "hasParam", "params": ["/ear", "/arm/min"]},
            ],
        ),
    ),
]
PARTS = {"system.multicall": 2}


def test_every_call_that_is_remembered_is_asked_here() -> None:
    """A row that becomes `mirrored` is a question of these tests, too."""
    assert {row.name for row in MASTER_CALLS.values() if row.mirrored} == {
        one for one, _ in QUESTIONS
    } - PARTS.keys()


async def begun() -> ControlParts:
    """Control with a talker and a parameter."""
    world = await ControlParts.begun()
    await world.register(world.node("/talker", 1), Kind.PUBLICATION, "/t", "std_msgs/String")
    await world.ask("setParam", "/talker", "/arm/max", 5)
    return world


@pytest.mark.parametrize(
    ("method", "params"), QUESTIONS, ids=[f"{one[0]} {number}" for number, one in enumerate(QUESTIONS)]
)
async def test_each_time_is_decided_and_recorded(method: str, params: tuple[Value, ...]) -> None:
    """Asked five times: five times the same answer, and as many records, whoever gave the answer."""
    world = await begun()
    answers, records = [], []
    for _ in range(5):
        world.records.events.clear()
        answers.append(await world.ask(method, *params))
        records.append(list(world.records.events))
    assert all(one == answers[0] for one in answers)
    assert all(one == records[0] for one in records)
    assert len(records[0]) == PARTS.get(method, 1)


async def test_a_reload_is_obeyed_at_the_next_question() -> None:
    """What was answered a moment ago is denied by the policy that is in force now."""
    world = await begun()
    for _ in range(3):
        assert (await world.ask("getSystemState", "/ear"))[0] == 1  # type: ignore[index]  # an answer is a list
    world.reload(OPEN.replace("[Commands]\n", "[Commands]\ngetSystemState=\n"))
    assert (await world.ask("getSystemState", "/ear"))[0] == 0  # type: ignore[index]  # an answer is a list


async def test_a_name_that_another_host_took_is_not_spoken_for() -> None:
    """A claim that was free when the question was asked first is decided by who holds the name now."""
    world = await begun()
    asking = ("getParam", "/late", "/arm/max")
    for _ in range(3):
        assert (await world.ask(*asking, host="10.0.0.9"))[0] == 1  # type: ignore[index]  # an answer is a list
    await world.register(world.node("/late", 5), Kind.PUBLICATION, "/x")
    assert (await world.ask(*asking, host="10.0.0.9"))[0] == 0  # type: ignore[index]  # an answer is a list


@pytest.mark.parametrize("obstacle", ["strict", "shut out", "no log"])
async def test_what_refuses_a_call_whatever_it_asks(obstacle: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where an answer waits for its record, or nothing may be answered, what is remembered is no way round."""
    world = await begun()
    for _ in range(3):
        await world.ask("getSystemState", "/ear")

    async def no_disk() -> str:
        return "the disk is full"

    if obstacle == "strict":
        monkeypatch.setattr(world.records, "strict", True)
        monkeypatch.setattr(world.records, "durable", no_disk, raising=False)
    elif obstacle == "shut out":
        monkeypatch.setattr(world.records, "shut_out", lambda _host: "the disk is nearly full")
    else:
        monkeypatch.setattr(world.records, "obstacle", "the log cannot be written")
    assert (await world.ask("getSystemState", "/ear"))[0] == 0  # type: ignore[index]  # an answer is a list


async def test_a_host_that_owes_for_its_records_waits_with_what_is_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is answered when it is its turn, which comes when the records are paid; then at once again."""
    at_once: list[bool] = []
    real = Repetitions.answer

    def observed(repetitions: Repetitions, request: HttpRequest) -> bytes | None:
        answer = real(repetitions, request)
        at_once.append(answer is not None)
        return answer

    monkeypatch.setattr(Repetitions, "answer", observed)
    world = await begun()
    for debt in ("", "", "", "10.0.0.5 has too many bytes of audit records to pay off", ""):
        world.records.debt = debt
        await world.ask("getSystemState", "/ear")
    assert at_once[-5:] == [False, False, True, False, True]


@pytest.mark.parametrize("seed", range(10))
async def test_after_any_change_the_answer_is_what_it_would_be_anew(seed: int) -> None:
    """Questions and changes in any order: each is asked in words that were used before, and in words that are new."""
    world = await begun()
    dice = random.Random(seed)  # noqa: S311 - no secret
    node = "http://10.0.0.5:4009/"
    changes: list[Callable[[], Any]] = [
        lambda: world.ask("setParam", "/talker", "/arm/max", 5),
        lambda: world.ask("setParam", "/talker", "/arm/max", 6),
        lambda: world.ask("setParam", "/talker", "/arm", {"max": [1], "min": 2}),
        lambda: world.ask("setParam", "/talker", "/arm/max/deeper", 1),
        lambda: world.ask("deleteParam", "/talker", "/arm/min"),
        lambda: world.ask("deleteParam", "/talker", "/arm"),
        lambda: world.ask("registerPublisher", "/ear", "/u", "a/B", node),
        lambda: world.ask("unregisterPublisher", "/ear", "/u", node),
        lambda: world.ask("registerSubscriber", "/ear", "/v", "a/C", node),
    ]
    policies = (OPEN, POLICY.format("/t=\n", ""), OPEN.replace("[Commands]\n", "[Commands]\ngetParam=\n"))
    for step in range(1, 151):
        chance = dice.random()
        if chance < 0.3:
            await dice.choice(changes)()
        elif chance < 0.35:
            world.reload(dice.choice(policies))
            await world.settle()
        method, params = dice.choice(QUESTIONS)
        again = await world.ask(method, *params)
        assert again == await world.ask(method, *params, spaces=step), (method, params)
