"""``srs``: rewriting against a rewriter that searches the whole string for every step."""

from random import Random

import pytest

from rosmop.logics.interface import RunFaultError
from rosmop.logics.srs import MAX_STRING, RewritingRun
from rosmop.tests.logics.driving import ABC, compiled, refusal, seeded, told

Rule = tuple[list[str], list[str], bool, bool]
"""Left side, right side (``["#", verdict]`` for a verdict), whether it begins, whether it ends."""

EQUAL = """
b a -> a b . c a -> a c . c b -> b c . a b -> E . E b -> b E . E a -> a E . E c -> #epsilon . c E -> #epsilon .
^ done -> #succeed . a done -> #fail . b done -> #fail . c done -> #fail . E done -> #fail .
"""


def draw(random: Random) -> list[Rule]:
    """Random rules that write no more than they take."""
    symbols = [*ABC[: random.randint(1, 3)], *(["X"] if random.random() < 0.5 else [])]
    rules = []
    for _ in range(random.randint(1, 4)):
        left = [random.choice(symbols) for _ in range(random.randint(1, 3))]
        right = [random.choice(symbols) for _ in range(random.randint(0, len(left) - 1))]
        if random.random() < 0.2:
            right = ["#", random.choice(["fail", "succeed"])]
        rules.append((left, right, random.random() < 0.2, random.random() < 0.2))
    return rules


def show(rules: list[Rule]) -> str:
    """The rules in the syntax of the logic; one that writes X, so that it may be looked for."""
    text = "a a a a a a a a a a a a a -> X . "
    for left, right, begins, ends in rules:
        written = f"#{right[1]}" if right[:1] == ["#"] else " ".join(right) or "#epsilon"
        text += f"{'^ ' * begins}{' '.join(left)}{' $' * ends} -> {written} .\n"
    return text


def rewritten(rules: list[Rule], string: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """What is left of a string, and the verdict."""
    while True:
        found = next(
            (
                (place, rule)
                for place in range(len(string))
                for rule in rules
                if string[place : place + len(rule[0])] == rule[0]
                and (not rule[2] or place == 0)
                and (not rule[3] or place + len(rule[0]) == len(string))
            ),
            None,
        )
        if found is None:
            return string, ()
        place, (left, right, _, _) = found
        if right[:1] == ["#"]:
            return [], (right[1],)
        string = string[:place] + right + string[place + len(left) :]


def test_random_systems() -> None:
    """The verdict after each event, on random traces."""
    random = seeded(5)
    for _ in range(600):
        rules = draw(random)
        trace = [random.choice(ABC) for _ in range(12)]
        expected, string, verdict = [], list[str](), tuple[str, ...]()
        for event in trace:
            if not verdict:
                string, verdict = rewritten(rules, [*string, event])
            expected.append(verdict)
        assert told(compiled("srs", show(rules)), trace) == expected, (rules, trace)


@pytest.mark.parametrize(
    ("trace", "verdict"),
    [("a b c", "succeed"), ("c c b a a b", "succeed"), ("", "succeed"), ("a b", "fail"), ("a b c c", "fail")],
)
def test_as_many_of_each(trace: str, verdict: str) -> None:
    """What no regular expression counts."""
    *before, last = told(compiled("srs", EQUAL, ("a", "b", "c", "done")), [*trace.split(), "done", "a"])
    assert (before[-1], last) == ((verdict,), (verdict,))
    assert not any(before[:-1])


def test_what_has_no_end_is_a_fault_and_changes_nothing() -> None:
    """A rule that grows, and one that goes round; the run goes on with the next event."""
    for rules in ("a -> a a .", "a -> X . X -> a ."):
        run = compiled("srs", f"{rules} b b -> #fail .").start(0)
        assert run.step(1, 0) == ()
        with pytest.raises(RunFaultError, match=r"for one event|symbols"):
            run.step(0, 0)
        assert run.step(1, 0) == ("fail",)


def test_comparing_long_rules_is_work() -> None:
    """A rule may be as long as the string; what would take seconds at each event is a fault, the rule alone is not."""
    long, half = "a " * 20_000, "a " * 10_000
    for formula, fault in (
        (f"{long} b -> #fail .", False),
        (f"{long} b -> #fail . {half} b -> #fail .", True),
    ):
        run = compiled("srs", formula).start(0)
        assert isinstance(run, RewritingRun)
        run.string = [0] * 50_000
        if fault:
            with pytest.raises(RunFaultError, match="more than 200000 steps"):
                run.step(0, 0)
        else:
            assert run.step(0, 0) == ()


def test_a_string_that_grows_for_ever_is_a_fault() -> None:
    """One symbol for each event, until there are too many."""
    run = compiled("srs", "a b -> #fail .").start(0)
    assert isinstance(run, RewritingRun)
    run.string = [0] * MAX_STRING
    with pytest.raises(RunFaultError, match="symbols"):
        run.step(0, 0)


@pytest.mark.parametrize(
    ("formula", "finding"),
    [
        ("a -> b", "expected `.` at the end of the rule"),
        ("-> a .", "expected an event or a symbol"),
        ("a -> .", "expected symbols, `#epsilon`"),
        ("a -> #done .", "`#done` has no meaning in srs"),
        ("a X -> b .", "`X` is neither an event nor on the right side of a rule"),
        ("", "expected an event or a symbol"),
    ],
)
def test_refusals(formula: str, finding: str) -> None:
    """With their place and what to write."""
    assert any(finding in text for text in refusal("srs", formula))
