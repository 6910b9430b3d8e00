"""``tfsm``: machines with time bounds against a simulation that looks at every instant."""

from random import Random

import pytest

from rosmop.tests.logics.driving import compiled, play, refusal, seeded

AB = ("a", "b")


class Ticking:
    """A random timed machine, simulated nanosecond by nanosecond: events first, then what ran out at this instant."""

    def __init__(self, random: Random) -> None:
        self.states = [f"s{number}" for number in range(random.randint(1, 3))]
        self.moves = {
            state: {event: random.choice(self.states) for event in AB if random.random() < 0.8}
            for state in self.states
        }
        self.timeouts = {
            state: (random.randint(1, 4), random.choice([*self.states, "fail"]))
            for state in self.states
            if random.random() < 0.7
        }
        self.timeouts.setdefault(self.states[0], (2, self.states[-1]))

    def text(self) -> str:
        """The machine in the syntax of the logic."""
        parts = []
        for state in self.states:
            clauses = [f"{event} -> {target}" for event, target in self.moves[state].items()]
            if state in self.timeouts:
                clauses.append(f"timeout {self.timeouts[state][0]} ns -> {self.timeouts[state][1]}")
            parts.append(f"{state} [ {', '.join(clauses)} ]")
        return "\n".join(parts)

    def play(self, trace: list[tuple[int, str]], start: int, end: int) -> list[tuple[int, tuple[str, ...]]]:
        """What is told when, of the instants from ``start`` to before ``end``."""
        state, entered = self.states[0], start
        record: list[tuple[int, tuple[str, ...]]] = []
        for instant in range(start, end):
            for time, event in trace:
                if time == instant:
                    state = self.moves.get(state, {}).get(event, "fail")
                    entered = instant
                    record.append((instant, (state,)))
            limit = self.timeouts.get(state)
            if limit is not None and instant == entered + limit[0]:
                state, entered = limit[1], instant
                record.append((instant, ("timeout", state)))
        return record


def test_random_machines_against_a_simulation() -> None:
    """Every move, by event or by timeout, happens at the instant that a simulation of all instants finds."""
    random = seeded(2)
    for _ in range(600):
        ticking = Ticking(random)
        start = random.randint(0, 3)
        times = sorted(random.randint(start, 20) for _ in range(random.randint(0, 7)))
        trace = [(time, random.choice(AB)) for time in times]
        machine = compiled("tfsm", ticking.text(), AB)
        assert play(machine.start(start), AB, trace, 25) == ticking.play(trace, start, 25), ticking.text()


def test_an_event_on_the_bound_is_in_time() -> None:
    """Bounds are closed: at exactly two seconds the event still counts, a nanosecond later it is too late."""
    text = "s0 [ a -> s1 ] s1 [ a -> s0, timeout 2s -> late ] late [ default late ]"
    run = compiled("tfsm", text, AB).start(0)
    assert play(run, AB, [(0, "a"), (2_000_000_000, "a")]) == [(0, ("s1",)), (2_000_000_000, ("s0",))]
    run = compiled("tfsm", text, AB).start(0)
    assert play(run, AB, [(0, "a"), (2_000_000_001, "a")]) == [
        (0, ("s1",)),
        (2_000_000_000, ("timeout", "late")),
        (2_000_000_001, ("late",)),
    ]


def test_without_timeouts_a_second_of_silence_is_told_once() -> None:
    """A machine without timeout clauses tells one second of silence after each event, once, and stays where it is."""
    run = compiled("tfsm", "s0 [ a -> s1, b -> s0 ] s1 [ a -> s0 ]", AB).start(0)
    second = 10**9
    assert play(run, AB, [(5 * second, "a"), (6 * second, "a")], 20 * second) == [
        (5 * second, ("s1",)),
        (6 * second, ("s0",)),
        (7 * second, ("timeout",)),
    ]


def test_timeout_cannot_block() -> None:
    """There is no message to drop when none came; states may block."""
    machine = compiled("tfsm", "s0 [ timeout 1 -> s0 ]", AB)
    assert machine.blocking_refused("timeout") is not None
    assert machine.blocking_refused("s0") is None
    assert machine.blocking_refused("fail") is None


def test_a_run_refuses_to_step_past_its_deadline() -> None:
    """A caller that forgot to expire the run is told, instead of being given a wrong verdict."""
    run = compiled("tfsm", "s0 [ timeout 1s -> s0, a -> s0 ]", AB).start(0)
    with pytest.raises(ValueError, match="expire the run first"):
        run.step(0, 2 * 10**9)


def test_time_does_not_run_backwards() -> None:
    """An event with an earlier time counts as of the latest time seen."""
    run = compiled("tfsm", "s0 [ timeout 1s -> s0, a -> s0 ]", AB).start(0)
    run.step(0, 500_000_000)
    run.step(0, 400_000_000)
    assert run.deadline == 1_500_000_000


def test_timeouts_must_be_positive_durations() -> None:
    """A timeout of zero, a second one, and a state named `timeout` are refused where they stand."""
    assert refusal("tfsm", "s [ timeout 0s -> s ]") == ["7:23: a timeout must be longer than 0"]
    assert "second `timeout`" in refusal("tfsm", "s [ timeout 1s -> s, timeout 2s -> s ]")[0]
    assert "category of its own" in refusal("tfsm", "timeout [ ]")[0]
