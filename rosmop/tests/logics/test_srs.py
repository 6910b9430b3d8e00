"""``srs``: rewriting is compared with a rewriter that searches the whole string in every step."""

from random import Random

import pytest

from rosmop.logics.interface import RunFaultError
from rosmop.logics.srs import MAX_STRING, RewritingRun
from rosmop.tests.logics.driving import ABC, compiled

Rule = tuple[list[str], list[str], bool, bool]
"""Left side, right side (``["#", verdict]`` for a verdict), whether it begins, whether it ends."""


def draw(random: Random) -> list[Rule]:
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
    text = "a a a a a a a a a a a a a -> X . "
    for left, right, begins, ends in rules:
        written = f"#{right[1]}" if right[:1] == ["#"] else " ".join(right) or "#epsilon"
        text += f"{'^ ' * begins}{' '.join(left)}{' $' * ends} -> {written} .\n"
    return text


def rewritten(rules: list[Rule], string: list[str]) -> tuple[list[str], tuple[str, ...]]:
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


def test_endless_rewriting_is_a_fault_and_changes_nothing() -> None:
    for rules in ("a -> a a .", "a -> X . X -> a ."):
        run = compiled("srs", f"{rules} b b -> #fail .").start(0)
        assert run.step(1, 0) == ()
        with pytest.raises(RunFaultError, match=r"for one event|symbols"):
            run.step(0, 0)
        assert run.step(1, 0) == ("fail",)


def test_comparing_long_rules_is_charged() -> None:
    long, half = "a " * 20_000, "a " * 10_000
    for formula, fault in (
        (f"{long} b -> #fail .", False),
        (f"{long} b -> #fail . {half} b -> #fail .", True),
    ):
        run = compiled("srs", formula).start(0)
        assert isinstance(run, RewritingRun)
        run.string = [0] * 50_000
        if fault:
            with pytest.raises(RunFaultError, match="more than 50000 steps"):
                run.step(0, 0)
        else:
            assert run.step(0, 0) == ()


def test_a_string_that_grows_for_ever_is_a_fault() -> None:
    run = compiled("srs", "a b -> #fail .").start(0)
    assert isinstance(run, RewritingRun)
    run.string = [0] * MAX_STRING
    with pytest.raises(RunFaultError, match="symbols"):
        run.step(0, 0)
