"""``fsm``: what the machine does is what was written."""

from random import Random

from rosmop.tests.logics.driving import ABC, compiled, refusal, seeded, told, traces


class Written:
    """A random machine, kept as it was drawn, and walked by looking it up."""

    def __init__(self, random: Random) -> None:
        self.states = [f"s{number}" for number in range(random.randint(1, 4))]
        targets = [*self.states, "fail"]
        self.moves = {
            state: {event: random.choice(targets) for event in ABC if random.random() < 0.6}
            for state in self.states
        }
        self.defaults = {state: random.choice(targets) for state in self.states if random.random() < 0.4}
        self.aliases = {
            f"group{number}": random.sample(targets, random.randint(1, len(targets)))
            for number in range(random.randint(0, 2))
        }

    def text(self, random: Random) -> str:
        """The machine in the syntax of the logic; commas come and go."""
        parts = []
        for state in self.states:
            clauses = [f"{event} -> {target}" for event, target in self.moves[state].items()]
            if state in self.defaults:
                clauses.insert(random.randint(0, len(clauses)), f"default {self.defaults[state]}")
            parts.append(f"{state} [ {random.choice([', ', ' ']).join(clauses)} ]")
        parts += [f"alias {name} = {', '.join(members)}" for name, members in self.aliases.items()]
        return "\n".join(parts)

    def after(self, trace: tuple[str, ...]) -> tuple[str, ...]:
        """The categories after a trace."""
        state = self.states[0]
        for event in trace:
            if state != "fail":
                state = self.moves[state].get(event, self.defaults.get(state, "fail"))
        return (state, *(name for name, members in self.aliases.items() if state in members))


def test_random_machines_on_all_short_traces() -> None:
    """A machine is in exactly the states and aliases that its text says, on every trace of up to four events."""
    random = seeded(1)
    for _ in range(150):
        written = Written(random)
        machine = compiled("fsm", written.text(random))
        assert set(machine.categories) == {*written.states, *written.aliases, "fail"}
        for trace in traces(ABC, 4):
            assert told(machine, trace)[-1] == written.after(trace)


def test_fail_is_for_good() -> None:
    """Once an event has no transition the machine fails, and tells so at each later event."""
    machine = compiled("fsm", "s0 [ a -> s0 ]")
    assert told(machine, "aba") == [("s0",), ("fail",), ("fail",)]


def test_names_that_are_words_elsewhere() -> None:
    """`timeout` and `alias` are ordinary names of events and states where they can be."""
    machine = compiled("FSM", "alias [ timeout -> timeout ] timeout [ default alias ]", ("timeout", "b"))
    assert told(machine, ["timeout", "b"]) == [("timeout",), ("alias",)]


def test_all_name_errors_are_found_at_once() -> None:
    """One reading tells every unknown event and state, each where it stands, with the nearest name."""
    findings = refusal("fsm", "start [ a -> stop,\n  aa -> start ]\nhalt [ default sart ]")
    assert findings == [
        "7:24: there is no state `stop`; there are: start, halt, fail",
        "8:3: `aa` is not an event of this specification; did you mean `a`?",
        "9:16: there is no state `sart`; did you mean `start`?",
    ]


def test_what_is_written_twice_is_refused() -> None:
    """States, transitions, defaults and aliases cannot be defined twice, nor take names that are taken."""
    assert "defined twice" in refusal("fsm", "s [ ] s [ ]")[0]
    assert "second transition" in refusal("fsm", "s [ a -> s, a -> s ]")[0]
    assert "second `default`" in refusal("fsm", "s [ default s, default s ]")[0]
    assert "category that exists" in refusal("fsm", "s [ ] alias s = s")[0]
    assert "category of its own" in refusal("fsm", "fail [ ]")[0]


def test_time_bounds_are_pointed_to_tfsm() -> None:
    """A timeout in an untimed machine is refused with the logic to use."""
    assert refusal("fsm", "s [ timeout 2s -> s ]") == [
        "7:15: a time bound in an untimed machine; write `tfsm:` for `fsm:`"
    ]


def test_incomplete_text() -> None:
    """A machine that breaks off, or is empty, is refused at its end."""
    assert "`]`" in refusal("fsm", "s [ a -> s")[0]
    assert "expected a state" in refusal("fsm", "")[0]
