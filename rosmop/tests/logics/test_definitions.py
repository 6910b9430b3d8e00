"""The logics that came last, against definitions that look at whole traces and share nothing with the product."""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from random import Random

import pytest

from rosmop.logics.interface import CompiledProperty
from rosmop.tests.logics.driving import ABC, compiled, play, refusal, seeded, told, traces
from rosmop.tests.logics.temporal import Tree

BOOLEAN: dict[str, Callable[..., bool | None]] = {
    "!": lambda x: None if x is None else not x,
    "and": lambda x, y: False if x is False or y is False else None if None in (x, y) else True,
    "or": lambda x, y: True if x or y else None if None in (x, y) else False,
    "=>": lambda x, y: True if x is False or y else None if None in (x, y) else False,
    "xor": lambda x, y: None if None in (x, y) else x != y,
    "<=>": lambda x, y: None if None in (x, y) else x == y,
}
"""The operators over true, false and not yet known (None)."""


def draw(random: Random, depth: int, signs: Sequence[tuple[str, int]], events: Sequence[str]) -> Tree:
    """Return a random formula of the operators, with the number of operands of each."""
    if depth == 0 or random.random() < 0.1:
        return ("event", random.choice(["true", *events, *events]))
    boolean = [(sign, 1 if sign == "!" else 2) for sign in BOOLEAN]
    sign, operands = random.choice([*signs, *signs, *boolean])
    bounds = random.choice([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 3)])
    if sign.endswith("[,]"):
        sign = f"{sign[:-3]}[{bounds[0]}ns,{bounds[1]}ns]"
    return (sign, *(draw(random, depth - 1, signs, events) for _ in range(operands)))


def show(tree: Tree) -> str:
    """Return the formula with all parentheses."""
    sign, *parts = tree
    if sign == "event":
        return str(parts[0])
    return f" {sign} ".join(["" if len(parts) == 1 else f"({show(parts[0])})", f"({show(parts[-1])})"])


def since(left: Sequence[bool], right: Sequence[bool]) -> bool:
    """Whether ``right`` holds at some place, and ``left`` at all behind it."""
    return any(found and all(left[place + 1 :]) for place, found in enumerate(right))


# ptcaret

CALLS = ("begin", "end", "call", "a")
UNARY = ("(*)", "<*>", "[*]", "(*a)", "<*a>", "[*a]", "@b", "@c",
         "<*s@b>", "[*s@b]", "<*s@c>", "[*s@c]", "<*s@bc>", "[*s@bc]")  # fmt: skip
CARET = [*((sign, 1) for sign in UNARY), *((sign, 2) for sign in ("S", "Sa", "Ss@b", "Ss@c", "Ss@bc"))]


def visible(trace: Sequence[str], now: int) -> tuple[list[int], list[int]]:
    """Return the places of the abstract past, and those among them at which an open call began."""
    seen: list[int] = []
    marks: list[int] = []
    for place in range(now + 1):
        if trace[place] == "begin":
            marks.append(len(seen))
        seen.append(place)
        if trace[place] == "end" and place < now:
            seen = seen[: marks.pop()] if marks else []
    return seen, [seen[mark] for mark in marks]


def caret(tree: Tree, trace: Sequence[str], now: int) -> bool:
    """Whether a formula of ptcaret holds at a place of a trace."""
    sign, *parts = tree
    if sign == "event":
        return parts[0] in ("true", trace[now])

    def at(part: Tree, places: Sequence[int]) -> list[bool]:
        return [caret(part, trace, place) for place in places]

    if sign in BOOLEAN:
        return bool(BOOLEAN[sign](*(caret(part, trace, now) for part in parts)))
    seen, begins = visible(trace, now)
    before = [place - 1 for place in begins if place > 0]
    both = [place for place in seen if trace[place] in ("begin", "call")]
    places = list(range(now + 1))
    if sign in ("(*)", "(*a)", "@b", "@c"):
        found = {"(*)": places[-2:-1], "(*a)": seen[-2:-1], "@b": begins[-1:]}
        found["@c"] = [place - 1 for place in begins[-1:] if place > 0]
        return any(at(parts[0], found[sign]))
    if sign == "Ss@c":
        return any(
            caret(parts[1], trace, begin - 1)
            and all(
                caret(parts[0], trace, place) for place in seen if place > begin and trace[place] == "call"
            )
            for begin in begins
            if begin > 0
        )
    scope = {"": places, "a": seen, "s@b": begins, "s@c": before, "s@bc": both}[sign.strip("<[]>*S")]
    if sign[0] == "S":
        return since(at(parts[0], scope), at(parts[1], scope))
    return any(at(parts[0], scope)) if sign[0] == "<" else all(at(parts[0], scope))


def test_calls_and_returns() -> None:
    """Every operator gives, after each event, what its row of the table says; calls may be unbalanced."""
    random = seeded(41)
    short = [trace for trace in traces(CALLS, 4) if len(trace) == 4]
    trees: list[Tree] = [(sign, ("event", "a")) for sign in UNARY]
    trees += [(sign, ("event", "a"), ("event", "call")) for sign, parts in CARET if parts == 2]
    trees += [draw(random, random.randint(1, 3), CARET, CALLS) for _ in range(250)]
    for number, tree in enumerate(trees):
        property_ = compiled("ptcaret", show(tree), CALLS)
        every = short if number < len(CARET) else [tuple(random.choices(CALLS, k=12)) for _ in range(3)]
        for trace in every:
            expected = [
                ("validation",) if caret(tree, trace, n) else ("violation",) for n in range(len(trace))
            ]
            assert told(property_, trace) == expected, (show(tree), trace)


# srs

Rule = tuple[tuple[str, ...], tuple[str, ...] | str, str, str]
"""Left side, right side or verdict, and the anchors."""


def rules_of(random: Random) -> list[Rule]:
    """Draw rules that come to an end: each makes the string shorter, or as long and smaller."""
    symbols = ("a", "b", "c", "d")
    rules: list[Rule] = [(("b", "a"), ("a", "d"), "", "")] if random.random() < 0.5 else []
    for _ in range(random.randint(1, 5)):
        left = tuple(random.choices(symbols, k=random.randint(1, 3)))
        right = min(
            left, tuple(random.choices(symbols, k=random.randint(0, len(left)))), key=lambda s: (len(s), s)
        )
        verdict = random.choice(["#fail", "#succeed"])
        anchors = random.choice(["", "", "^"]), random.choice(["", "", "$"])
        rules.append((left, verdict if random.random() < 0.2 or right == left else right, *anchors))
    return rules


def rewritten(rules: list[Rule], trace: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield the verdicts after each event."""
    string: tuple[str, ...] = ()
    verdict = ""
    for event in trace:
        string += (event,)
        while not verdict:
            matches = [
                (start, number)
                for number, (left, _, begin, end) in enumerate(rules)
                for start in range(len(string) - len(left) + 1)
                if string[start : start + len(left)] == left
                and not (begin and start)
                and not (end and start + len(left) < len(string))
            ]
            if not matches:
                break
            start, number = min(matches)
            left, right, _, _ = rules[number]
            if isinstance(right, str):
                verdict = right[1:]
            else:
                string = string[:start] + right + string[start + len(left) :]
        yield (verdict,) if verdict else ()


def test_rewriting() -> None:
    """The leftmost match of the first rule is replaced; anchors stay; a verdict is for good."""
    random = seeded(42)
    for _ in range(400):
        rules = rules_of(random)
        text = "a a a a a a a a a a a a -> d ."  # so that `d` is a symbol of some string
        for left, right, begin, end in rules:
            written = right if isinstance(right, str) else " ".join(right) or "#epsilon"
            text += f" {begin} {' '.join(left)} {end} -> {written} ."
        rules.insert(0, (("a",) * 12, ("d",), "", ""))
        property_ = compiled("srs", text)
        for trace in (tuple(random.choices(ABC, k=20)), *random.sample(list(traces(ABC, 4)), 20)):
            assert told(property_, trace) == list(rewritten(rules, trace)), (text, trace)


# ltl with past and future

MIXED = [*((sign, 1) for sign in ("o", "[]", "<>", "(*)", "<*>", "[*]", "~o", "~(*)")),
         *((sign, 2) for sign in ("U", "R", "S", "~U", "~S"))]  # fmt: skip


def endless(tree: Tree, word: Sequence[str], back: int) -> list[bool]:
    """Return where a formula holds in a word that goes on, behind its end, at ``back``."""
    sign, *parts = tree
    if sign == "event":
        return [parts[0] in ("true", event) for event in word]
    values = [endless(part, word, back) for part in parts]
    x, y = values[0], values[-1]
    size = len(word)
    if sign in BOOLEAN:
        return [bool(BOOLEAN[sign](*operands)) for operands in zip(*values, strict=True)]
    if sign in ("(*)", "~(*)"):
        return [sign[0] == "~", *x[:-1]]
    if sign in ("<*>", "[*]", "S", "~S"):
        if sign in ("[*]", "~S"):
            x, y = [not value for value in x], [not value for value in y]
        left = [True] * size if len(parts) == 1 else x
        found = [since(left[: n + 1], y[: n + 1]) for n in range(size)]
        return [not value for value in found] if sign in ("[*]", "~S") else found
    ahead = [[*range(n, size), *range(back, n)] for n in range(size)]
    if sign in ("o", "~o"):
        return [*x[1:], x[back]]
    if sign in ("[]", "<>"):
        x = [sign == "<>"] * size
    release = sign in ("[]", "R", "~U")
    until = [
        any(
            y[n] != release and all(x[m] != release for m in places[:count]) for count, n in enumerate(places)
        )
        for places in ahead
    ]
    return [value != release for value in until]


def test_past_and_future() -> None:
    """A verdict is what all endless continuations have in common."""
    random = seeded(43)
    events = ("a", "b")
    lassos = [
        (u, v)
        for n in range(6)
        for u in product(events, repeat=n)
        for k in (1, 2)
        for v in product(events, repeat=k)
    ]
    for _ in range(60):
        tree = ("o", draw(random, random.randint(1, 3), MIXED, events))
        property_ = compiled("ltl", show(tree), events)
        values: dict[tuple[str, ...], set[bool]] = {}
        for stem, loop in lassos:
            word = (*stem, *loop * 5)
            value = endless(tree, word, len(word) - len(loop))[0]
            for length in range(1, 4):
                values.setdefault(word[:length], set()).add(value)
        for trace in traces(events, 3):
            found = values[trace]
            expected = ("validation" if True in found else "violation",) if len(found) == 1 else ()
            assert told(property_, trace)[-1] == expected, (show(tree), trace)


# mtl about the future

TIMED = [*((f"{sign}[,]", 1) for sign in ("previously", "once", "historically", "next", "eventually", "always")),
         ("since[,]", 2), ("until[,]", 2)]  # fmt: skip
Timed = Sequence[tuple[int, str]]


def conclude(values: Sequence[bool | None], sign: str) -> bool | None:
    """Return what all values come to by one operator."""
    result: bool | None = sign == "and"
    for value in values:
        result = BOOLEAN[sign](result, value)
    return result


def known(tree: Tree, trace: Timed, place: int, rest: int) -> bool | None:
    """Return what a formula is worth at an event when later events come at ``rest`` at the earliest."""
    sign, *parts = tree
    time, event = trace[place]
    if sign == "event":
        return parts[0] in ("true", event)
    if sign in BOOLEAN:
        return BOOLEAN[sign](*(known(part, trace, place, rest) for part in parts))
    name, _, bounds = sign.partition("[")
    low, high = (int(bound.removesuffix("ns")) for bound in bounds.rstrip("]").split(","))

    def at(part: Tree, places: Sequence[int]) -> list[bool | None]:
        return [known(part, trace, other, rest) for other in places]

    places = [other for other in range(len(trace)) if low <= abs(trace[other][0] - time) <= high]
    past = name in ("previously", "once", "historically", "since")
    places = [other for other in places if (other <= place if past else other >= place)]
    waits = [None] if not past and rest <= time + high else []
    if name in ("previously", "next"):
        other = place + (1 if name == "next" else -1)
        if 0 <= other < len(trace):
            return other in places and known(parts[0], trace, other, rest)
        return None if waits else False
    if len(parts) == 1:
        return conclude([*at(parts[0], places), *waits], "or" if name in ("once", "eventually") else "and")
    between = [range(other + 1, place + 1) if past else range(place, other) for other in places]
    found = [
        conclude([known(parts[1], trace, other, rest), *at(parts[0], inner)], "and")
        for other, inner in zip(places, between, strict=True)
    ]
    later = conclude([*at(parts[0], range(place, len(trace))), *waits], "and") if waits else False
    return conclude([*found, later], "or")


def expected(tree: Tree, trace: Timed, end: int) -> list[tuple[int, set[str]]]:
    """Return the verdicts with their times: at events, and at instants that pass without one."""
    record = []
    decided: set[int] = set()
    moments = [(time, 0, count) for count, (time, _) in enumerate(trace, 1)]
    moments += [(time, 1, sum(other <= time for other, _ in trace)) for time in range(end)]
    for time, passed, count in sorted(moments):
        news = set()
        for place in sorted(set(range(count)) - decided):
            value = known(tree, trace[:count], place, time + passed)
            if value is not None:
                decided.add(place)
                news.add("validation" if value else "violation")
        if news:
            record.append((time, news))
    return record


def test_time_about_the_future() -> None:
    """A verdict comes with the event, or with the end of the instant, that decides it."""
    random = seeded(44)
    for _ in range(600):
        tree = draw(random, random.randint(1, 3), TIMED, ABC)
        property_: CompiledProperty = compiled("mtl", show(tree))
        times = sorted(random.choices(range(7), k=random.randint(1, 7)))
        trace = [(time, random.choice(ABC)) for time in times]
        found = play(property_.start(times[0]), ABC, trace, 30)
        record = [(time, set(names)) for time, names in found if names]
        assert record == expected(tree, trace, 30), (show(tree), trace)


# What is rejected by choice, as docs/logics.md says

REJECTED = [
    ("ptcaret", "a -> a -> a", "without parentheses"),
    ("ptcaret", "a ~Sa a", "write `!` for a negation"),
    ("ptcaret", "o a", "is about the future"),
    ("srs", "a -> #fail", "expected `.` at the end of the rule"),
    ("srs", "a -> .", "expected symbols, `#epsilon`, `#fail` or `#succeed`"),
    ("srs", "^ $ -> #fail .", "a rule rewrites at least one"),
    ("srs", "^ a -> ^ .", "expected symbols, `#epsilon`, `#fail` or `#succeed`"),
    ("srs", "x -> #fail .", "no string has it"),
    ("ltl", "a S begin", "write `ptltl:`"),
    ("ltl", "[](a => a S begin)", "without parentheses"),
    ("mtl", "eventually[1s,inf] a", "has no upper bound"),
    ("mtl", "next a", "has no upper bound"),
    ("mtl", "once[0,1s) a", "bounds are closed"),
]


@pytest.mark.parametrize(("logic", "formula", "finding"), REJECTED)
def test_rejected_by_choice(logic: str, formula: str, finding: str) -> None:
    """The finding says what is missing or what to write."""
    (found,) = refusal(logic, formula, CALLS)
    assert finding in found
