"""``tfsm``: machines with time bounds are compared with a simulation of every nanosecond."""

from random import Random

import pytest

from rosmop.tests.logics.driving import compiled

AB = ("a", "b")


class Ticking:
    """A random timed machine, simulated by nanosecond: events come first, then the timeouts of that time."""

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
        parts = []
        for state in self.states:
            clauses = [f"{event} -> {target}" for event, target in self.moves[state].items()]
            if state in self.timeouts:
                clauses.append(f"timeout {self.timeouts[state][0]} ns -> {self.timeouts[state][1]}")
            parts.append(f"{state} [ {', '.join(clauses)} ]")
        return "\n".join(parts)

    def play(self, trace: list[tuple[int, str]], start: int, end: int) -> list[tuple[int, tuple[str, ...]]]:
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


def test_a_run_refuses_to_step_past_its_deadline() -> None:
    run = compiled("tfsm", "s0 [ timeout 1s -> s0, a -> s0 ]", AB).start(0)
    with pytest.raises(ValueError, match="expire the run first"):
        run.step(0, 2 * 10**9)


def test_time_does_not_run_backwards() -> None:
    run = compiled("tfsm", "s0 [ timeout 1s -> s0, a -> s0 ]", AB).start(0)
    run.step(0, 500_000_000)
    run.step(0, 400_000_000)
    assert run.deadline == 1_500_000_000
