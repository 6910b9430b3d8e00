import json
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.form.findings import Position
from rosmop.logics import ltl, mtl, ptltl
from rosmop.logics.catalogue import LOGICS, compile_property
from rosmop.logics.formula import Syntax
from rosmop.logics.interface import ClockedProperty, CompiledProperty, FormulaError, Source
from rosmop.logics.lexer import TokenReader
from rosmop.tests.examples import examples
from rosmop.tests.logics import test_bounded, test_ltl, test_ptltl
from rosmop.tests.logics.driving import ABC, ORIGIN, compiled, play, refusal, seeded

ROOT = Path(__file__).parents[3]
VERDICTS = ("violation", "validation")
# A new logic adds a row: an example, its categories, and the events of its example in docs/reference/logics.md.
ROWS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "fsm": ("s [ a -> s ]", ("s", "fail"), ("start", "stop")),
    "tfsm": ("s [ timeout 1s -> s ]", ("s", "fail", "timeout"), ("on", "off", "ready")),
    "ere": ("a b*", ("match", "fail"), ("open", "read", "write", "close")),
    "ltl": ("[] a", VERDICTS, ("request", "grant")),
    "ptltl": ("[*] a", VERDICTS, ("fire", "unsafe", "armed")),
    "cfg": ("S -> a S b | epsilon", ("match", "fail"), ("lock", "unlock")),
    "mtl": ("once[0,1s] a", VERDICTS, ("fire", "safe")),
    "pattern": ("globally: no a", VERDICTS, ("armed", "disarmed", "fire", "safe")),
    "srs": ("a b -> #epsilon . c -> #fail .", ("fail", "succeed"), ("a", "b", "c", "done")),
    "ptcaret": ("a => <*> b", VERDICTS, ("begin", "end", "lock", "write")),
}


@pytest.mark.parametrize("logic", LOGICS)
def test_every_logic_in_any_case(logic: str) -> None:
    for name in (logic, logic.upper(), logic.title()):
        assert compile_property(name, ROWS[logic][0], ABC, ORIGIN).categories == ROWS[logic][1]


@pytest.mark.parametrize(
    ("logic", "formula"),
    [
        *((logic, row[0]) for logic, row in ROWS.items()),
        ("tfsm", "s [ a -> t, timeout 2ns -> t ] t [ b -> s ] alias end = t"),
        ("cfg", "S -> S a S b | epsilon"),
        ("pattern", "after a until c: a causes b within 3ns"),
        ("pattern", "globally: some b within 3ns enforced by f"),
        ("ptltl", " xor ".join("(*) " * number + "a" for number in range(1, 16))),
        ("mtl", "a => (!c since[2ns,inf] b) or previously[0,3ns] c"),
        ("mtl", "once[0,3ns] (a => eventually[0,2ns] b)"),
        ("ptcaret", "a => <*a> b"),
    ],
)
def test_every_property_can_be_rebuilt_from_data(
    logic: str, formula: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def noting(begin: Callable[..., None]) -> Callable[..., None]:
        def noted(self: CompiledProperty, *arguments: Any) -> None:
            given[:] = arguments
            begin(self, *arguments)

        return noted

    events = (*ABC, "begin", "end")
    kinds = [*CompiledProperty.__subclasses__(), *ClockedProperty.__subclasses__()]
    with monkeypatch.context() as patched:
        for kind in kinds:
            if "__init__" in vars(kind):
                patched.setattr(kind, "__init__", noting(kind.__init__))
        one = compiled(logic, formula, events)
    assert type(one) in LOGICS[logic].properties, "the row of the logic"
    hints = [hint for name, hint in get_type_hints(type(one).__init__).items() if name != "return"]
    read = [
        msgspec.msgpack.decode(msgspec.msgpack.encode(argument), type=hint)
        for argument, hint in zip(given, hints, strict=True)
    ]
    other = type(one)(*read)
    random = seeded(5)
    for _ in range(20):
        trace = list(zip(sorted(random.choices(range(30), k=20)), random.choices(events, k=20), strict=True))
        assert play(one.start(0), events, trace, 40) == play(other.start(0), events, trace, 40)


@pytest.mark.parametrize("logic", LOGICS)
def test_categories_that_may_block(logic: str) -> None:
    monitor = compiled(logic, ROWS[logic][0])
    refused = {category for category in monitor.categories if monitor.blocking_refused(category)}
    assert refused == ({"timeout"} if logic == "tfsm" else set())
    with pytest.raises(KeyError):
        monitor.blocking_refused("no such category")


@pytest.mark.parametrize("logic", LOGICS)
def test_the_documented_example_compiles(logic: str) -> None:
    page = (ROOT / "docs" / "reference" / "logics.md").read_text(encoding="utf-8")
    example = page.split(f"\n## {logic}\n")[1].split("\n\n")[0]
    formula = example.split("```")[1] if "```" in example else example.strip("`")
    assert compiled(logic, formula, ROWS[logic][2]).categories


@pytest.mark.complete
@pytest.mark.parametrize(
    ("tests", "syntax"), [(test_ltl, ltl.SYNTAX), (test_ptltl, ptltl.SYNTAX), (test_bounded, mtl.SYNTAX)]
)
def test_every_operator_is_compared_with_a_naive_meaning_and_described(
    tests: ModuleType, syntax: Syntax
) -> None:
    spellings = defaultdict(set)
    for operators in (syntax.unary, *(level.operators for level in syntax.levels)):
        for sign, operator in operators.items():
            spellings[operator].add(sign)
    drawn = {sign.strip() for signs in tests.PRINTER.spelled.values() for sign in signs}
    missing = [
        f"{operator}: add it to PRINTER, and its naive meaning, in {tests.__name__}"
        for operator, signs in spellings.items()
        if not signs & drawn
    ]
    page = (ROOT / "docs" / "reference" / "logics.md").read_text(encoding="utf-8")
    missing += [
        f"{operator}: describe it in docs/reference/logics.md"
        for operator, signs in spellings.items()
        if not any(re.search(rf"(?<!\w){re.escape(sign)}(?!\w)", page) for sign in signs)
    ]
    assert not missing, "\n".join(missing)


def test_a_logic_may_have_no_signs() -> None:
    reader = TokenReader(Source("plain", "3 a // b", ABC, ORIGIN), ())
    assert [reader.take().text for _ in range(3)] == ["3", "a", ""]
    with pytest.raises(FormulaError, match="`%` has no meaning in plain"):
        TokenReader(Source("plain", "3 %", ABC, ORIGIN), ())


def test_an_unknown_logic_has_the_position_of_its_name() -> None:
    with pytest.raises(FormulaError) as refused:
        compile_property("ptlt", "a", ABC, ORIGIN, Position("test.rv", 7, 1))
    assert str(refused.value) == "test.rv:7:1: error: unknown logic `ptlt`; did you mean `ptltl`?"


def test_differential_dynamic_logic_is_refused_by_name() -> None:
    with pytest.raises(FormulaError, match=r"`dL` .* is not supported: .* as `mtl` or `pattern`"):
        compile_property("dL", "x", ("a",), ORIGIN)


@pytest.mark.parametrize("logic", LOGICS)
def test_an_empty_formula_is_refused(logic: str) -> None:
    assert "expected" in refusal(logic, "  ")[0]


@pytest.mark.parametrize("logic", LOGICS)
def test_comments_and_lines(logic: str) -> None:
    assert compiled(logic, f"// first\n/* then\n */ {ROWS[logic][0]} // last").categories == ROWS[logic][1]
    assert refusal(logic, "// first\n  %")[0].startswith("8:3: `%` has no meaning")


@pytest.mark.parametrize("logic", LOGICS)
def test_a_megabyte_is_refused(logic: str) -> None:
    assert refusal(logic, "a" * 1_000_000) == [
        "7:11: a formula of more than 100000 characters; split it into several properties"
    ]


WORDS = [
    "a", "b", "zz", "s0", "S", "T", "(", ")", "[", "]", "{", ",", "|", "&", "~", "*", "+", "^", "^3", "->", "=>", "<=>",
    "and", "or", "xor", "not", "!", "U", "R", "o", "[]", "<>", "(*)", "[*]", "<*>", "once", "since", "historically",
    "always", "previously",
    "[0,1s]", "[2,inf]", "5", "ms", "default", "alias", "=", "timeout", "fail", "epsilon", "empty", ":",
    "globally", "after", "until", "no", "some", "causes", "requires", "forbids", "within", "true", "false", "~U", "~S",
]  # fmt: skip


@pytest.mark.parametrize("logic", LOGICS)
@settings(max_examples=examples(300), derandomize=True, suppress_health_check=list(HealthCheck))
@given(words=st.lists(st.sampled_from(WORDS), max_size=14), tail=st.text(max_size=3))
def test_any_text_is_compiled_or_refused(logic: str, words: list[str], tail: str) -> None:
    formula = " ".join(words) + tail
    try:
        monitor = compile_property(logic, formula, ABC, ORIGIN)
    except FormulaError as error:
        assert error.findings
        assert all(
            ORIGIN <= finding.position <= ORIGIN.within(formula, len(formula)) for finding in error.findings
        )
    else:
        run = monitor.start(0)
        for number in range(6):
            assert set(run.step(number % 3, 0)) <= set(monitor.categories)


HOSTILE = {
    "fsm": ["s [ a -> " * 5_000, "".join(f"s{i} [ default s{i + 1} ]\n" for i in range(4_000)) + "s4000 []"],
    "tfsm": ["s [ timeout 1s -> s " * 4_000],
    "ere": ["~(" * 40 + "a* b" + ")^3" * 40, "(" + "|".join(["a b c"] * 9_000) + ")*", "(a|b)* a (a|b)^40"],
    "ltl": [
        " U ".join(["(a"] * 90) + " U b" + ")" * 90,
        " xor ".join(f"<>(a and {'o ' * i} b)" for i in range(60)),
    ],
    "ptltl": [" S ".join(["a"] * 20_000), "(*) " * 20_000 + "a", " and ".join(["(*)" * 60 + " a"] * 400)],
    "cfg": [
        "S -> " + "S S " * 8_000 + "| a",
        ", ".join(f"S{i} -> S{i + 1} S{i + 1}" for i in range(2_000)) + ", S2000 -> a",
    ],
    "mtl": [" and ".join(f"once[{i},{i + 1}] a" for i in range(4_000)), "once[0,1] " * 9_000 + "a"],
    "pattern": ["globally: " * 9_000, "after a until " * 5_000],
    "srs": ["a -> a a .", "a b -> b a . " * 6_000, " ".join(["a"] * 40_000) + " -> b ."],
    "ptcaret": [" S ".join(["a"] * 20_000), "(*) " * 20_000 + "a", " and ".join(["(*)" * 60 + " a"] * 400)],
}

PROGRAM = """
import json, resource, sys
from rosmop.logics.catalogue import compile_property
from rosmop.logics.interface import FormulaError, RunFaultError
from rosmop.form.findings import Position
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
logic, formula = json.load(sys.stdin)
try:
    run = compile_property(logic, formula, ("a", "b", "c"), Position("f", 1, 1)).start(0)
    for event in range(6):
        run.step(event % 3, 0)
except (FormulaError, RunFaultError) as error:
    print(error)
"""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("logic", "number"), [(logic, i) for logic, texts in HOSTILE.items() for i in range(len(texts))]
)
def test_hostile_formulas_stay_within_bounds(logic: str, number: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps([logic, HOSTILE[logic][number]]),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
