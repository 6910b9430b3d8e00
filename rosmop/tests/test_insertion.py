"""Phases decide which monitors see an inserted message: compared with a naive composition of edit automata."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import definitions, load, refused
from rosmop.tests.logics.driving import ABC, seeded
from rosmop.tests.logics.test_pattern import Meaning
from rosmop.tests.test_published import CAP, FAST, MUX, speeds

END = 30
Timed = list[tuple[int, str]]


@dataclass
class Phase:
    """Forbids, inserts at deadlines (trigger, answer, bound), and inserts at events.

    `seen` is its trace: the messages that subscribers got, without what later phases insert. `tried` counts, for each
    insertion, the triggers that it has answered or tried to.
    """

    forbidden: Sequence[Meaning]
    due: Sequence[tuple[str, str, int]]
    echoes: dict[str, str]
    seen: Timed = field(default_factory=list)
    tried: list[int] = field(default_factory=list)

    def text(self, name: str) -> str:
        parts = [
            f"event {one}() /{one} std_msgs/Empty '{{}}' {{ {self._publish(self.echoes.get(one))} }}"
            f" void f_{one}() {{ {self._publish(one)} }}"
            for one in ABC
        ]
        parts += [
            f"pattern: globally: {x} causes {y} within {w} ns enforced by f_{y}" for x, y, w in self.due
        ]
        parts += [f"pattern: {meaning.text()} @violation {{ DROP; }}" for meaning in self.forbidden]
        return f"{name}() {{ std_msgs::Empty m; {' '.join(parts)} }}"

    @staticmethod
    def _publish(event: str | None) -> str:
        return "" if event is None else f"PUBLISH(/{event}, std_msgs/Empty, m);"

    def forbids(self, time: int, event: str) -> bool:
        return any(meaning.unmet((*self.seen, (time, event)), time)[0] for meaning in self.forbidden)

    def deadlines(self) -> Iterator[tuple[int, int]]:
        self.tried = self.tried or [0] * len(self.due)
        for number, (trigger, answer, within) in enumerate(self.due):
            for place, (time, event) in enumerate(self.seen):
                later = (one for _, one in self.seen[place + 1 :])
                if event == trigger and place >= self.tried[number] and answer not in later:
                    yield time + within, number
                    break


class Naive:
    """Phases in their order, by the definition of edit automata; `out` is the trace of subscribers."""

    def __init__(self, phases: Sequence[Phase]) -> None:
        self.phases = phases
        self.out: Timed = []
        self.inserted = set[tuple[int, str]]()

    def judge(self, time: int, event: str, first: int = 0) -> bool:
        inserted = []
        passes = True
        for place in range(first, len(self.phases)):
            phase = self.phases[place]
            if event in phase.echoes:
                inserted.append((phase.echoes[event], place + 1))
            if phase.forbids(time, event):
                passes = False
                break
        if passes:
            self.out.append((time, event))
            for phase in self.phases[first:]:
                phase.seen.append((time, event))
        for one, behind in inserted:
            self.judge(time, one, behind)
        return passes

    def wait(self, until: int) -> None:
        while True:
            waiting = [
                (time, place, number)
                for place, phase in enumerate(self.phases)
                for time, number in phase.deadlines()
                if time < until
            ]
            if not waiting:
                return
            time, place, number = min(waiting)
            phase = self.phases[place]
            phase.tried[number] = len(phase.seen)
            answer = phase.due[number][1]
            if self.judge(time, answer, place):
                self.inserted.add((place, answer))


def drawn(random: Random) -> Phase:
    due = {
        (random.choice(ABC), random.choice(ABC)): random.randint(1, 6) for _ in range(random.randint(0, 3))
    }
    forbidden = [drawn_ban(random) for _ in range(random.randint(0, 2))]
    echoes = {random.choice(ABC): random.choice(ABC) for _ in range(max(0, random.randint(-2, 2)))}
    return Phase(forbidden, [(*pair, within) for pair, within in due.items()], echoes)


def drawn_ban(random: Random) -> Meaning:
    kind = random.choice(("no", "forbids", "requires"))
    opens, closes = random.choice((None, None, *ABC)), random.choice((None, None, *ABC))
    within = None if random.random() < 0.3 else random.randint(0, 5)
    closes = None if closes == opens else closes
    return Meaning(kind, opens, closes, random.choice(ABC), random.choice(ABC), within)


def sent(outcome: Outcome, time: int, event: str) -> Timed:
    found = [one for before in outcome.before for one in published(before)]
    found += [] if outcome.result == "dropped" else [(time, event)]
    return found + published(outcome)


def published(outcome: Outcome) -> Timed:
    found: Timed = []
    for number, one in enumerate(outcome.published):
        judged = outcome.judged.get(number)
        if judged is None or judged.result != "dropped":
            found.append((outcome.time, one.topic[1:]))
        found += published(judged) if judged is not None else []
    return found


def check_refusal(
    random: Random, phases: Sequence[Phase], files: Sequence[str], error: SpecificationError
) -> None:
    """Check the claim of each error: whatever comes, no deadline of the phase inserts the answer."""
    claims = set[tuple[int, str]]()
    for finding in error.findings:
        if finding.severity == "error":
            [answer] = re.findall(r"drops the message that `f_(.)` publishes", finding.text)
            claims.add((int(files["wxyz".index(finding.position.file)].split("(")[0][1:]), answer))
    assert claims
    for _ in range(10):
        naive = Naive([Phase(phase.forbidden, phase.due, phase.echoes) for phase in phases])
        time = 1
        for _ in range(random.randint(1, 12)):
            time += random.randint(0, 3)
            naive.wait(time)
            naive.judge(time, random.choice(ABC))
        naive.wait(END + 60)
        assert claims.isdisjoint(naive.inserted), error


def compare(random: Random, traces: int) -> tuple[int, int]:
    suppressed = inserted = 0
    for _ in range(traces // 10):
        phases = [drawn(random) for _ in range(random.randint(1, 3))]
        names = [f"s{number}" for number in range(len(phases))]
        texts = [phase.text(name) for phase, name in zip(phases, names, strict=True)]
        texts.append(f"order {' < '.join(names)};")
        random.shuffle(texts)
        try:
            compiled = compiled_from(dict(zip("wxyz", texts, strict=False)), definitions())
        except SpecificationError as error:
            check_refusal(random, phases, texts, error)
            continue
        for _ in range(10):
            monitors = MonitorSet.of(compiled)
            monitors.start(0)
            naive = Naive([Phase(phase.forbidden, phase.due, phase.echoes) for phase in phases])
            time, got, given = 1, list[tuple[int, str]](), 0
            for _ in range(random.randint(1, 12)):
                time += random.randint(0, 3)
                event = random.choice(ABC)
                given += 1
                got += sent(monitors.process(f"/{event}", b"", time), time, event)
                naive.wait(time)
                naive.judge(time, event)
                assert got == naive.out, texts
            got += [one for outcome in monitors.advance(END + 60) for one in published(outcome)]
            naive.wait(END + 60)
            assert got == naive.out, texts
            inserted += len(got) > given
            suppressed += len(got) < given
    return suppressed, inserted


def test_random_phases() -> None:
    suppressed, inserted = compare(seeded(51), 200)
    assert suppressed > 5 and inserted > 60


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(52, 56))
def test_many_random_phases(seed: int) -> None:
    suppressed, inserted = compare(seeded(seed), 2_500)
    assert suppressed > 60 and inserted > 700


HEARTBEAT = """beat() { std_msgs::Empty m; int n; void f() { PUBLISH(/b, std_msgs/Empty, m); }
    event b() /b std_msgs/Empty '{}' { n++; }
    pattern: globally: b causes b within 1s enforced by f }"""


@pytest.mark.parametrize(("order", "times"), [("order beat;", [1, 2, 3, 4]), ("", [1])])
def test_an_inserted_answer_is_a_trigger_again_in_an_ordered_specification(
    order: str, times: list[int]
) -> None:
    monitors = load(HEARTBEAT + order)
    monitors.process("/b", b"", 0)
    due = [one.time // 10**9 for one in monitors.advance(5 * 10**9) if one.published]
    assert (due, monitors.value("beat", "n")) == (times, len(times) + 1 if order else 1)


ORDERS = [
    ("order cap < mux;", [9.0]),
    ("order mux < cap;", [0.22]),
    ("order mux < other < cap;", [0.22]),
    ("order cap;", [9.0]),
]


@pytest.mark.parametrize(("order", "speed"), ORDERS)
def test_an_order_replaces_the_order_of_the_files(order: str, speed: list[float]) -> None:
    monitors = load(CAP, y=MUX, z=order)
    assert speeds(monitors.process("/joy", FAST, 1)) == speed
    assert [*monitors.names] == (["mux", "cap"] if speed == [0.22] else ["cap", "mux"])
    unknown = [str(one) for one in monitors.warnings if "no specification is named `other`" in one.text]
    assert bool(unknown) is ("other" in order)
    plain = load(CAP, y=MUX)
    assert [monitor.code.identity for monitor in sorted(monitors.monitors, key=lambda one: one.name)] == [
        monitor.code.identity for monitor in sorted(plain.monitors, key=lambda one: one.name)
    ]


def test_specifications_without_a_place_in_the_order_stay_where_they_are() -> None:
    texts = {name: CAP.replace("cap()", f"{name}()") for name in "pqrst"}
    for order, expected in (
        ("order t < q;", "prstq"), ("order t < p; order s < q < p;", "rsqtp"), ("order p < q < r < s < t;", "pqrst"),
    ):  # fmt: skip
        monitors = load(order, **texts)  # type: ignore[arg-type]  # names
        assert "".join(monitors.names) == expected
    warnings = load("order p < q;", y=texts["p"], z=texts["q"]).warnings
    rivals = [warning for warning in warnings if "the last word" in warning.text]
    assert rivals == []


@pytest.mark.parametrize(
    "order", ["order cap < cap;", "order cap < mux; order mux < cap;", "order a < b < c < a;"]
)
def test_a_circle_is_refused(order: str) -> None:
    assert "would come before itself" in refused(CAP + MUX + order)[0].text
