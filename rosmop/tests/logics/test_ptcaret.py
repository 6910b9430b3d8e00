"""``ptcaret``: compared with the definition, which searches the whole trace for every question."""

from collections.abc import Sequence
from copy import copy

import pytest

from rosmop.logics.interface import RunFaultError
from rosmop.logics.ptcaret import MAX_DEPTH
from rosmop.tests.logics.driving import compiled, seeded, told
from rosmop.tests.logics.temporal import CONNECTIVES, Tree, draw
from rosmop.text.parser import parse

EVENTS = ("begin", "end", "call", "a")
SIGNS = {
    "previously": "(*)", "once": "<*>", "historically": "[*]", "since": "S",
    "ab previously": "(*a)", "ab once": "<*a>", "ab historically": "[*a]", "ab since": "Sa",
    "not": "!", "implies": "=>", "iff": "<=>",
}  # fmt: skip
UNARY = {name: 1 for name in SIGNS if name not in ("since", "ab since", "implies", "iff")}
TEMPORAL = [name for name in SIGNS if name not in ("not", "implies", "iff")]


def show(tree: Tree) -> str:
    operator, *operands = tree
    if operator == "event":
        return str(operands[0])
    sign = SIGNS.get(operator, operator)
    texts = [f"({show(operand)})" for operand in operands]
    return f"{sign} {texts[0]}" if len(texts) == 1 else f" {sign} ".join(texts) or str(operator)


def before(trace: Sequence[str], place: int) -> int:
    """Return the previous event in the abstract past, which skips returned calls, or -1."""
    depth, at = 0, place - 1
    if at >= 0 and trace[at] == "end":
        while at >= 0:
            depth += {"end": 1, "begin": -1}.get(trace[at], 0)
            if not depth:
                return before(trace, at)
            at -= 1
    return at


def holds(tree: Tree, trace: Sequence[str], place: int) -> bool:
    operator, *operands = tree
    if operator in ("event", "true", "false"):
        return bool(operator == "true" or (operator == "event" and trace[place] == operands[0]))
    name = operator.removeprefix("ab ")
    if name in ("previously", "once", "historically", "since"):
        earlier = before(trace, place) if operator != name else place - 1
        if name == "previously":
            return earlier >= 0 and holds(operands[0], trace, earlier)
        now = holds(operands[-1], trace, place)
        if name == "historically":
            return now and (earlier < 0 or holds(tree, trace, earlier))
        left = name == "once" or holds(operands[0], trace, place)
        return now or (left and earlier >= 0 and holds(tree, trace, earlier))
    return CONNECTIVES[operator](*(holds(operand, trace, place) for operand in operands))


def verdicts(tree: Tree, trace: Sequence[str]) -> list[tuple[str, ...]]:
    return [("validation",) if holds(tree, trace, place) else ("violation",) for place in range(len(trace))]


def test_a_copy_of_a_run_is_independent() -> None:
    random = seeded(13)
    for _ in range(200):
        tree = draw(random, 3, TEMPORAL, UNARY, EVENTS)
        begun, *ends = ([random.choice(EVENTS) for _ in range(6)] for _ in range(3))
        run = compiled("ptcaret", show(tree), EVENTS).start(0)
        for event in begun:
            run.step(EVENTS.index(event), 0)
        runs = run, copy(run)
        found: tuple[list[tuple[str, ...]], ...] = [], []
        for events in zip(*ends, strict=True):
            for one, event, told_of_it in zip(runs, events, found, strict=True):
                told_of_it.append(one.step(EVENTS.index(event), 0))
        for end, told_of_it in zip(ends, found, strict=True):
            assert told_of_it == verdicts(tree, [*begun, *end])[6:], (show(tree), begun, end)


BEGIN, CALL, A = ("event", "begin"), ("event", "call"), ("event", "a")
X = ("previously", A)
DERIVED: list[tuple[str, Tree]] = [
    ("@b (*) a", ("ab since", ("not", BEGIN), ("and", BEGIN, X))),
    ("@c a", ("ab since", ("not", BEGIN), ("and", BEGIN, ("previously", A)))),
    ("<*s@b> (*) a", ("ab once", ("and", BEGIN, X))),
    ("[*s@c] a", ("not", ("ab once", ("and", BEGIN, ("previously", ("not", A)))))),
    ("<*s@bc> (*) a", ("ab once", ("and", ("or", BEGIN, CALL), X))),
    ("call Ss@b (*) a", ("ab since", ("implies", BEGIN, CALL), ("and", BEGIN, X))),
    ("(*) a Ss@c a", ("ab since", ("implies", CALL, X), ("and", BEGIN, X))),
    ("(*) a Ss@bc (*) a", ("ab since", ("implies", ("or", BEGIN, CALL), X), ("and", ("or", BEGIN, CALL), X))),
    ("a Sa begin S call", ("ab since", A, ("since", BEGIN, CALL))),
    ("a S begin Sa call", ("ab since", ("since", A, BEGIN), CALL)),
    ("call Ss@b a Sa begin", ("ab since", ("implies", BEGIN, CALL), ("and", BEGIN, ("ab since", A, BEGIN)))),
]


@pytest.mark.parametrize(("text", "tree"), DERIVED)
def test_derived_operators(text: str, tree: Tree) -> None:
    random = seeded(12)
    for _ in range(100):
        trace = [random.choice(EVENTS) for _ in range(12)]
        assert told(compiled("ptcaret", text, EVENTS), trace) == verdicts(tree, trace)


IN_A_FILE = [
    *(text for text, _tree in DERIVED),
    "a Ss@bc a Ss@c a Ss@b a",
    "a => @b  a",
    "!@c a // @fail",
    "@b @c a",
]
BEHIND = {"": [], "@violation { } @c { }": ["violation", "c"], "// why\n@c /* {} */ { }": ["c"]}


@pytest.mark.parametrize("text", IN_A_FILE)
@pytest.mark.parametrize("behind", BEHIND)
def test_a_formula_needs_no_escapes_in_a_file(text: str, behind: str) -> None:
    (found,) = parse(f"s() {{ ptcaret: {text}\n{behind} }}", "x.rv").specifications[0].properties
    assert found.formula.removesuffix("// why").rstrip() == text
    assert [handler.category for handler in found.handlers] == BEHIND[behind]


def test_too_many_open_calls_are_a_fault_and_change_nothing() -> None:
    run = compiled("ptcaret", "<*a> a", EVENTS).start(0)
    for _ in range(MAX_DEPTH):
        run.step(0, 0)
    with pytest.raises(RunFaultError, match="calls are open"):
        run.step(0, 0)
    assert run.step(1, 0) == ("violation",)
