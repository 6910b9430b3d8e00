"""Patterns that refer to an earlier message, compared with a naive account that keeps all messages."""

import math
import operator
from collections.abc import Callable
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.fast.build import require_loadable
from rosmop.fast.serialization import encode
from rosmop.tests.both_ways import BothWays, plain
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import definitions

EVENTS = "".join(
    f"event {name}(double x) /plain own/Plain '{{kind:{kind}, x:x}}' {{ }}\n"
    for kind, name in enumerate("abpq")
)
OPERATORS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
VALUES = (-1.0, 0.0, 0.5, 1.0, 2.0, math.inf, -math.inf, math.nan)


def formula(random: Random) -> tuple[str, str, str, bool, str, int | None]:
    scope = random.choice(("globally", "after p", "until q", "after p until q"))
    verb, sign, swapped = (
        random.choice(("forbids", "requires")),
        random.choice([*OPERATORS]),
        random.random() < 0.5,
    )
    condition = f"@A.x {sign} x + 0.25" if swapped else f"x {sign} @A.x + 0.25"
    within = random.choice((None, None, 3))
    first, second = ("a", "b") if verb == "forbids" else ("b", "a")
    bound = "" if within is None else f" within {within}ms"
    text = f"pattern: {scope}: {first} as A {verb} {second} {{{condition}}}{bound}"
    return text, scope, verb, swapped, sign, within


@pytest.mark.parametrize("seed", range(examples(360)))
def test_violations_are_those_of_a_naive_account(seed: int) -> None:
    """Each violation is dropped, so that the rest of the trace is judged as if it had not been sent."""
    random = Random(seed)  # noqa: S311  draws examples, not keys
    text, scope, verb, swapped, sign, within = formula(random)
    both = BothWays(f"s() {{ {EVENTS} {text} @violation {{ DROP; }} }}")
    compare = OPERATORS[sign]
    earlier: list[tuple[int, float]] = []
    is_open, is_over, time = not scope.startswith("after"), False, 0
    for _ in range(40):
        time += random.choice((0, 1, 2)) * 10**6
        kind, x = random.randrange(4), random.choice(VALUES)
        met = any(
            _holds(compare, verb, swapped, x, stored)
            for then, stored in earlier
            if within is None or time - then <= within * 10**6
        )
        violates = kind == 1 and is_open and not is_over and met == (verb == "forbids")
        passed = both.check([plain(0, x, kind)], time=time)
        assert bool(passed) is not violates, (text, time)
        if kind == 0 and is_open:
            earlier.append((time, x))
        if kind == 2 and not is_open:
            is_open, earlier = True, []
        if kind == 3 and "until" in scope and is_open:
            is_open, is_over, earlier = False, not scope.startswith("after"), []


def _holds(
    compare: Callable[[float, float], bool], verb: str, swapped: bool, late: float, early: float
) -> bool:
    """`other` is a value of the second event of the text, `named` of the one named `A`."""
    named, other = (early, late) if verb == "forbids" else (late, early)
    return compare(named, other + 0.25) if swapped else compare(other, named + 0.25)


def test_a_message_may_refer_to_earlier_ones_of_its_own_topic() -> None:
    both = BothWays(
        "s() { event a(double x) /plain own/Plain '{x:x}' { }"
        " pattern: globally: a as A forbids a {x <= @A.x} @violation { DROP; } }"
    )
    assert [len(both.check([plain(0, x)])) for x in (1.0, 3.0, 2.0, 3.0, 4.0)] == [1, 1, 0, 0, 1]


def test_the_module_takes_these_messages_and_the_text_is_loadable() -> None:
    text = f"s() {{ {EVENTS} pattern: globally: a as A forbids b {{x < @A.x}} @violation {{ }} }}"
    compiled = compiled_from({"x.rv": text}, definitions())
    require_loadable(encode(compiled))
    assert [warning.text for warning in compiled.warnings] == [
        f"no property uses the event `{name}`" for name in "pq"
    ]
    both = BothWays(text)
    for number in range(8):
        both.check([plain(0, float(number), 0)])
    assert both.came["together"]
