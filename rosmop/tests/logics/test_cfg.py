"""``cfg``: recognisers are compared with a table of spans, which has no positions, stacks or continuations."""

from random import Random

import pytest

from rosmop.logics import parsing
from rosmop.logics.cfg import GrammarRun
from rosmop.logics.interface import FiniteProperty, RunFaultError
from rosmop.tests.logics.driving import ABC, compiled, refusal, seeded, told

Rules = dict[str, list[tuple[str, ...]]]


def draw(random: Random) -> Rules:
    heads = ["S", "T", "U"][: random.randint(1, 3)]
    symbols = [*heads, *ABC[: random.randint(1, 3)]]
    return {
        head: [
            tuple(random.choice(symbols) for _ in range(random.choice([0, 1, 1, 2, 2, 3, 3])))
            for _ in range(random.randint(1, 3))
        ]
        for head in heads
    }


def show(rules: Rules, random: Random) -> str:
    comma = random.choice([",", ""])
    return f"{comma}\n".join(
        f"{head} -> {' | '.join(' '.join(body) or 'epsilon' for body in bodies)}"
        for head, bodies in rules.items()
    )


def derives(rules: Rules, start: str, word: tuple[str, ...]) -> bool:
    size = len(word)
    spans: dict[str, set[tuple[int, int]]] = {head: set() for head in rules}
    for event in (*ABC, *word):
        spans[event] = {(i, i + 1) for i in range(size) if word[i] == event}
    changed = True
    while changed:
        changed = False
        for head, bodies in rules.items():
            for body in bodies:
                reach = {(i, i) for i in range(size + 1)}
                for symbol in body:
                    reach = {(i, k) for i, j in reach for start, k in spans[symbol] if start == j}
                if not reach <= spans[head]:
                    spans[head] |= reach
                    changed = True
    return (0, size) in spans[start]


def prefixes(rules: Rules) -> Rules:
    """``A'`` derives the prefixes of ``A``; all symbols must be productive."""
    made = dict(rules)
    for head, bodies in rules.items():
        made[head + "'"] = [()]
        for body in bodies:
            for cut, symbol in enumerate(body):
                last = symbol + "'" if symbol in rules else symbol
                made[head + "'"].append((*body[:cut], last))
    return made


def productive(rules: Rules) -> Rules:
    good: set[str] = set(ABC)
    while fresh := {
        h for h, bodies in rules.items() if h not in good and any(good.issuperset(b) for b in bodies)
    }:
        good |= fresh
    return {
        head: [body for body in bodies if good.issuperset(body)]
        for head, bodies in rules.items()
        if head in good
    }


def expected(rules: Rules, word: tuple[str, ...]) -> tuple[str, ...]:
    useful = productive(rules)
    if "S" not in useful:
        return ("fail",)
    if derives(useful, "S", word):
        return ("match",)
    return () if derives(prefixes(useful), "S'", word) else ("fail",)


LONG: dict[str, dict[str, list[tuple[str, ...]]]] = {
    "S -> a S b | epsilon": {"S": [("a", "S", "b"), ()]},
    "S -> S S | a S b | epsilon": {"S": [("S", "S"), ("a", "S", "b"), ()]},
    "S -> a S b S | c": {"S": [("a", "S", "b", "S"), ("c",)]},
    "S -> a S a | b S b | c | epsilon": {"S": [("a", "S", "a"), ("b", "S", "b"), ("c",), ()]},
    "S -> S a T | T, T -> T b U | U, U -> c": {
        "S": [("S", "a", "T"), ("T",)],
        "T": [("T", "b", "U"), ("U",)],
        "U": [("c",)],
    },
    "S -> T S | T, T -> a T b | epsilon": {"S": [("T", "S"), ("T",)], "T": [("a", "T", "b"), ()]},
}


@pytest.mark.parametrize("text", LONG)
def test_longer_traces(text: str) -> None:
    random = seeded(13)
    monitor = compiled("cfg", text)
    for _ in range(15):
        word = tuple(random.choices(ABC, k=4)) if random.random() < 0.3 else _walk(monitor, random)
        assert told(monitor, word) == [expected(LONG[text], word[: end + 1]) for end in range(len(word))], (
            word
        )


def _walk(monitor: object, random: Random) -> tuple[str, ...]:
    trace: tuple[str, ...] = ()
    for _ in range(12):
        choices = [event for event in ABC if told(monitor, (*trace, event))[-1] != ("fail",)]  # type: ignore[arg-type]  # a property
        trace = (*trace, random.choice(choices or ABC))
    return trace


def test_left_and_right_recursive_grammars_agree_on_long_traces() -> None:
    ways = [
        "S -> S a S b | epsilon",
        "S -> a S b S | epsilon",
        "S -> S S | a S b | epsilon",
        "S -> T S | epsilon, T -> a S b",
    ]
    monitors = [compiled("cfg", way, ("a", "b")) for way in ways]
    random = seeded(14)
    for _ in range(10):
        trace, depth = [], 0
        for _ in range(300):
            event = "a" if depth == 0 or random.random() < 0.5 else "b"
            depth += 1 if event == "a" else -1
            trace.append(event)
        depths = [trace[: end + 1].count("a") - trace[: end + 1].count("b") for end in range(300)]
        for monitor in monitors:
            assert told(monitor, trace) == [("match",) if depth == 0 else () for depth in depths]


def test_regular_grammars_become_tables() -> None:
    for text in (
        "S -> a S | b",
        "S -> S a | b",
        "S -> a* (b | c)+",
        "S -> T U, T -> a | epsilon, U -> b U | c",
    ):
        assert isinstance(compiled("cfg", text), FiniteProperty), text


def test_flat_traces_take_no_memory() -> None:
    run = compiled("cfg", "S -> a S b S | epsilon", ("a", "b")).start(0)
    assert isinstance(run, GrammarRun)
    for _ in range(10_000):
        run.step(0, 0)
        run.step(1, 0)
    assert run.frame is not None
    assert run.frame.depth <= 1


def test_deep_traces() -> None:
    run = compiled("cfg", "S -> a S b | c", ABC).start(0)
    told_last = [run.step(0, 0) for _ in range(200_000)][-1]
    assert told_last == ()
    run.step(2, 0)
    assert [run.step(1, 0) for _ in range(200_000)][-1] == ("match",)
    assert run.step(1, 0) == ("fail",)


def test_a_run_that_would_grow_too_far_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    nested, ambiguous = compiled("cfg", "S -> a S b | c"), compiled("cfg", "S -> a S a | a")
    monkeypatch.setattr(parsing, "MAX_DEPTH", 50)
    run = nested.start(0)
    taken = 0
    with pytest.raises(RunFaultError, match="nested more than 50 deep"):
        for _ in range(60):
            run.step(0, 0)
            taken += 1
    assert taken == 51
    assert run.step(2, 0) == ()
    assert [run.step(1, 0) for _ in range(taken)][-1] == ("match",)
    monkeypatch.undo()
    monkeypatch.setattr(parsing, "MAX_WIDTH", 20)
    run = ambiguous.start(0)
    with pytest.raises(RunFaultError, match="too many ways"):
        for _ in range(60):
            run.step(0, 0)


def test_long_grammars_are_rejected_once() -> None:
    assert len(refusal("cfg", "S -> " + "(" * 5000)) == 1
    assert len(refusal("cfg", "S -> " + "a " * 45_000)) == 1
