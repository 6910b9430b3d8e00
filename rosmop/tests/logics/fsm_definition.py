from random import Random

from rosmop.tests.logics.driving import ABC


class Written:
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
        parts = []
        for state in self.states:
            clauses = [f"{event} -> {target}" for event, target in self.moves[state].items()]
            if state in self.defaults:
                clauses.insert(random.randint(0, len(clauses)), f"default {self.defaults[state]}")
            parts.append(f"{state} [ {random.choice([', ', ' ']).join(clauses)} ]")
        parts += [f"alias {name} = {', '.join(members)}" for name, members in self.aliases.items()]
        return "\n".join(parts)

    def after(self, trace: tuple[str, ...]) -> tuple[str, ...]:
        state = self.states[0]
        for event in trace:
            if state != "fail":
                state = self.moves[state].get(event, self.defaults.get(state, "fail"))
        return (state, *(name for name, members in self.aliases.items() if state in members))
