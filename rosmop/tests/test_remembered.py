"""The state of a property outlives its process (for whole monitors: `relay/monitors/test_state_keeper.py`)."""

from functools import cache
from itertools import count
from random import Random
from typing import Any

import msgspec
import pytest

from rosmop.check.sources import compiled_from
from rosmop.run import state_of_runs
from rosmop.run.engine import MonitorSet
from rosmop.run.state import states_of
from rosmop.run.state_of_runs import MAX_PARTS, StateTooLargeError, dump, run_of
from rosmop.tests.examples import examples
from roswire.standard import standard_definitions

FORMULAS = {
    "fsm": "fsm: a [ e0 -> b, default a ] b [ e1 -> c, default b ] c [ default a ]",
    "tfsm": "tfsm: a [ e0 -> b, default a ] b [ e1 -> a, timeout 5ms -> c, default b ] c [ default a ]",
    "ere": "ere: (e0 e1 | e2)*",
    "ltl": "ltl: [](e0 => o (e1 or e2))",
    "ptltl": "ptltl: e0 -> (*) (e1 or e2)",
    "past with two bounds": "mtl: once[1ms,7ms] e0 and once[0,3ms] e1",
    "past with a clock": "mtl: once[0,4ms] e0",
    "future": "mtl: e0 -> eventually[0,6ms] e1",
    "future and past": "mtl: (e0 until[1ms,9ms] e1) or not once[2ms,5ms] (e2 and eventually[0,3ms] e0)",
    "next": "mtl: e0 -> next[0,5ms] (e1 or eventually[0,4ms] e2)",
    "since of what is open": "mtl: (eventually[0,3ms] e1) since[0,8ms] e0",
    "cfg": "cfg: S -> e0 S e1 | e2 | epsilon",
    "ambiguous cfg": "cfg: S -> S S | e0 S e1 | e2 | epsilon",
    "srs": "srs: e0 e1 -> #epsilon . e2 e2 e2 -> #fail .",
    "ptcaret": "ptcaret: e0 -> @b e2",
    "pattern": "pattern: globally: e0 causes e1 within 6ms",
    "pattern with a scope": "pattern: after e0 until e2: e1 forbids e2 within 4ms",
}


@cache
def compiled(formula: str) -> MonitorSet:
    events = " ".join(f"event e{n}() /e{n} std_msgs/Empty '{{}}' {{ }}" for n in range(3))
    if formula.startswith("ptcaret"):
        events = events.replace("event e0", "event begin").replace("event e1", "event end")
        formula = formula.replace("e0", "begin").replace("e1", "end")
    return MonitorSet.of(compiled_from({"s.rv": f"s() {{ {events}\n{formula}\n }}"}, standard_definitions()))


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("seed", range(examples(42)))
def test_a_run_goes_on_where_it_was(name: str, seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    [declared] = compiled(FORMULAS[name]).compiled.specifications[0].properties
    formula = declared.property
    run, copied, time = formula.start(0), formula.start(0), 0
    for _ in range(60):
        time += random.choice((0, 1, 500_000, 2_000_000, 5_000_000))
        while (deadline := run.deadline) is not None and deadline < time:
            copied = again(formula, copied)
            assert copied.deadline == deadline
            assert copied.expire() == run.expire()
        copied = again(formula, copied)
        event = random.randrange(3)
        assert copied.step(event, time) == run.step(event, time)
        assert copied.deadline == run.deadline


def again(formula: Any, run: Any) -> Any:
    return run_of(formula, msgspec.msgpack.decode(msgspec.msgpack.encode(dump(run))), 0)


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("data", [[], [[], []], [["x"], []], [[["o", 3]], []], 7, [[10**6, 0, 0], []], None])
def test_an_invalid_state_of_a_property_is_refused(name: str, data: object) -> None:
    formula = compiled(FORMULAS[name]).compiled.specifications[0].properties[0].property
    with pytest.raises(ValueError):
        run_of(formula, data, 0)


def test_a_deep_stack_is_too_large_to_keep() -> None:
    formula = compiled(FORMULAS["cfg"]).compiled.specifications[0].properties[0].property
    run = formula.start(0)
    for _ in range(2 * MAX_PARTS):
        run.step(0, 0)
    with pytest.raises(StateTooLargeError):
        dump(run)


def test_a_slice_that_is_too_large_loses_only_the_state_that_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once the slice has ended, or is small again, all slices of its specification are kept."""
    monkeypatch.setattr(state_of_runs, "MAX_PARTS", 50)
    events = " ".join(
        f"event {name}(std::string k) /{name} std_msgs/String '{{data:k}}' {{ }}"
        for name in ("open", "close")
    )
    text = f"s(std::string k) {{ {events}\ncfg: S -> open S close | epsilon\n@fail {{ }} }}"
    monitors = MonitorSet.of(compiled_from({"s.rv": text}, standard_definitions()))
    monitors.start(0)
    [group] = monitors.kept_groups()
    sent, stored = count(1), dict(enumerate(group.parts()))

    def send(name: str, key: str) -> None:
        monitors.process(f"/{name}", len(key).to_bytes(4, "little") + key.encode(), next(sent))
        stored.update(group.changed_parts())

    def kept_slices() -> int | str:
        rows = [([group.names[0]], group.layout, data, None) for data in (group.base(), *stored.values())]
        _found, slices, lost = states_of(rows)
        return lost.get("s") or len(slices["s"])

    for key in ("a", "b", "c"):
        send("open", key)
    assert kept_slices() == 3
    for _ in range(100):
        send("open", "a")
    send("open", "b")
    assert kept_slices() == "a property has more than 50 parts"
    for _ in range(102):
        send("close", "a")
    send("close", "c")
    assert kept_slices() == 3
