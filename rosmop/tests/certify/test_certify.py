import ast
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

import rosmop.certify
from rosmop.certify.check import _CHECKS, _NO_AUTOMATON, MAX_STEPS, AutomatonTables, certify
from rosmop.certify.formula_reader import UnsupportedFormulaError, WordReader
from rosmop.certify.properties import DEFECT, certificate_of, certificates_of
from rosmop.check.sources import compiled_from
from rosmop.form.findings import Position
from rosmop.logics import catalogue, ltl, mtl, ptltl
from rosmop.logics.automaton import Automaton
from rosmop.logics.catalogue import compile_property
from rosmop.logics.formula import Syntax
from rosmop.logics.interface import CompiledProperty, FiniteProperty, FormulaError, Logic, Source
from rosmop.logics.tfsm import TimedStateMachine
from rosmop.tests.examples import examples
from roswire.standard import standard_definitions

EVENTS = ["a", "b", "c", "d"]
ORIGIN = Position("x.rv", 1, 1)
Draw = Callable[[Random, int, Sequence[str]], str]


def drawn(unary: Sequence[str], binary: Sequence[str], leaves: Sequence[str]) -> Draw:
    def draw(random: Random, depth: int, events: Sequence[str]) -> str:
        if depth == 0 or random.random() < 0.15:
            return random.choice([*events, *events, *leaves])
        operator = random.choice([*unary, *binary])
        if operator in unary:
            return f"{operator} ({draw(random, depth - 1, events)})"
        return f"({draw(random, depth - 1, events)}) {operator} ({draw(random, depth - 1, events)})"

    return draw


def expression(random: Random, depth: int, events: Sequence[str]) -> str:
    if depth == 0 or random.random() < 0.15:
        return random.choice([*events, *events, "epsilon", "empty"])
    inner = f"({expression(random, depth - 1, events)})"
    other = f"({expression(random, depth - 1, events)})"
    return random.choice([f"{inner}*", f"{inner}+", f"{inner}^{random.randint(0, 3)}", f"~{inner}",
                          f"{inner} | {other}", f"{inner} & {other}", f"{inner} {other}"])  # fmt: skip


def pattern(random: Random, _depth: int, events: Sequence[str]) -> str:
    """Return a pattern without a time bound, in which no event both opens and closes the scope."""
    a, b, c, d = (random.choice(events) for _ in range(4))
    scopes = ["globally", f"after {a}", f"until {b}"] + [f"after {a} until {b}"] * (a != b)
    bodies = [f"no {c}", f"some {c}", *(f"{c} {verb} {d}" for verb in ("causes", "requires", "forbids"))]
    return f"{random.choice(scopes)}: {random.choice(bodies)}"


def machine(random: Random, _depth: int, events: Sequence[str]) -> str:
    states = [f"s{number}" for number in range(random.randint(1, 5))]
    text = ""
    for state in states:
        moves = [
            f"{event} -> {random.choice([*states, 'fail'])}" for event in events if random.random() < 0.6
        ]
        if random.random() < 0.5:
            moves.append(f"default {random.choice(states)}")
        text += f"{state} [ {random.choice([', ', ' ']).join(moves)} ] "
    return text + f"alias x = {', '.join(random.sample([*states, 'fail'], 2))}"


def timed_machine(random: Random, depth: int, events: Sequence[str]) -> str:
    states = machine(random, depth, events).split("] ")
    limits = ["timeout 2s -> s0", "timeout 0.5 ms -> fail", "timeout 3 -> s0"]
    return "] ".join(
        f"{state} {random.choice(limits)}" if random.random() < 0.5 else state for state in states[:-1]
    ) + ("] " + states[-1])


LOGICS: dict[str, Draw] = {
    "ere": expression,
    "fsm": machine,
    "ltl": drawn(
        ["!", "o", "[]", "<>"], ["U", "R", "~U", "and", "or", "xor", "=>", "<=>"], ["true", "false"]
    ),
    "ltl with past": drawn(
        ["!", "o", "[]", "<>", "(*)", "<*>", "[*]", "~(*)"],
        ["U", "R", "S", "~S", "and", "or", "=>"],
        ["true"],
    ),
    "mtl": drawn(
        ["!", "previously", "once", "once[0,inf]", "historically"],
        ["since", "since [0 ms, inf]", "and", "or", "xor", "=>", "<=>"],
        ["true", "false"],
    ),
    "pattern": pattern,
    "ptltl": drawn(
        ["!", "(*)", "~(*)", "<*>", "[*]"], ["S", "~S", "and", "or", "xor", "=>", "<=>"], ["true", "false"]
    ),
    "tfsm": timed_machine,
}


def properties(logic: str, seed: int, count: int) -> list[CompiledProperty]:
    random = Random(seed)  # noqa: S311  no secret
    found: list[CompiledProperty] = []
    while len(found) < count:
        events = EVENTS[: random.randint(1, 4)]
        formula = LOGICS[logic](random, random.randint(1, 4), events)
        if random.random() < 0.4:
            events.append("unnamed")
        try:
            found.append(compile_property(logic.removesuffix(" with past"), formula, events, ORIGIN))
        except FormulaError:
            continue  # for example: too large, only about the past, or no second member for the machine's alias
    return found


@pytest.mark.parametrize("logic", LOGICS)
def test_compiled_properties_are_proved(logic: str) -> None:
    for compiled in properties(logic, 1, 150):
        certificate = certificate_of(compiled)
        assert certificate.proved, (compiled.formula, compiled.events, certificate.text)


def tables_of(compiled: CompiledProperty) -> AutomatonTables:
    assert isinstance(compiled, FiniteProperty | TimedStateMachine)
    made = compiled.automaton
    timeouts = compiled.timeouts if isinstance(compiled, TimedStateMachine) else ()
    return AutomatonTables(made.initial, made.table, made.verdicts, timeouts)


def same_verdicts(tables: AutomatonTables, other: AutomatonTables) -> bool:
    seen = {(tables.initial, other.initial)}
    waiting = list(seen)
    for left, right in waiting:
        targets = list(zip(tables.table[left], other.table[right], strict=True))
        if tables.timeouts and (tables.timeouts[left] or other.timeouts[right]):
            first, second = tables.timeouts[left], other.timeouts[right]
            if first is None or second is None or first[0] != second[0]:
                return False
            targets.append((first[1], second[1]))
        for pair in targets:
            if tables.verdicts[pair[0]] != other.verdicts[pair[1]]:
                return False
            if pair not in seen:
                seen.add(pair)
                waiting.append(pair)
    return True


def broken(random: Random, tables: AutomatonTables) -> AutomatonTables:
    """Return tables with one compiler fault: a wrong transition, two merged states, or a wrong verdict."""
    table, verdicts = [list(row) for row in tables.table], list(tables.verdicts)
    state, other = random.randrange(len(table)), random.randrange(len(table))
    timeouts = list(tables.timeouts)
    match random.choice(("way", "way", "merged", "verdict", "limit")):
        case "way":
            table[state][random.randrange(len(table[state]))] = other
        case "merged":
            table = [[other if target == state else target for target in row] for row in table]
        case "verdict":
            verdicts[state] = verdicts[other]
        case _ if timeouts:
            timeouts[state] = timeouts[other]
        case _:
            verdicts[state] = ()
    return AutomatonTables(tables.initial, table, verdicts, timeouts)


@pytest.mark.parametrize("logic", LOGICS)
def test_an_invalid_automaton_is_refused(logic: str) -> None:
    compiled = next(iter(properties(logic, 5, 5)))
    made = tables_of(compiled)
    states = len(made.table)
    others = [
        replace(made, initial=made.initial - states),
        replace(made, initial=states),
        replace(made, table=[[target - states for target in row] for row in made.table]),
        replace(made, table=[*made.table[:-1], [states] * len(made.table[0])]),
        replace(made, table=[[*row, 0] for row in made.table]),
        replace(made, verdicts=[*made.verdicts, ()]),
        replace(made, timeouts=[*([None] * states), (1, 0)]),
        replace(made, timeouts=[(1, states if logic == "tfsm" else 0)] * states),
    ]
    for other in others:
        assert certify(compiled.logic, compiled.formula, compiled.events, other).wrong, other


@pytest.mark.parametrize("logic", LOGICS)
def test_a_thousand_faults_of_compilers_are_refused(logic: str) -> None:
    random = Random(2)  # noqa: S311  no secret
    refused = 0
    for compiled in properties(logic, 3, 1000):
        tables = tables_of(compiled)
        wrong = broken(random, tables)
        certificate = certify(compiled.logic, compiled.formula, compiled.events, wrong)
        if same_verdicts(tables, wrong):
            assert certificate.proved, (compiled.formula, certificate.text)
        else:
            assert certificate.wrong, (compiled.formula, wrong)
            refused += 1
        if refused == examples(200):
            return
    pytest.fail(f"only {refused} changes were faults")


def test_a_fault_is_shown_by_a_trace() -> None:
    wrong = AutomatonTables(0, [[0, 1], [1, 1]], [(), ("violation",)])
    certificate = certify("ltl", "[](a => o (!b U a))", ["a", "b"], wrong)
    assert certificate.wrong
    assert certificate.text == "after b the automaton says violation, the definition nothing"


@pytest.mark.parametrize(
    ("logic", "formula", "why"),
    [
        ("cfg", "S -> a S b | epsilon", "grammars are not checked"),
        ("mtl", "once[0,1s] a", "it has time bounds"),
        ("pattern", "globally: a causes b within 1s", "it has a time bound"),
        ("pattern", "after a until a: some b", "one event opens and closes the scope"),
    ],
)
def test_unproved_properties_have_a_reason(logic: str, formula: str, why: str) -> None:
    certificate = certificate_of(compile_property(logic, formula, ["a", "b"], ORIGIN))
    assert not certificate.proved
    assert not certificate.wrong
    assert why in certificate.text
    assert certificate.text.endswith("tested, not proved")


def test_a_machine_that_is_too_large_is_not_proved() -> None:
    events = [f"e{number}" for number in range(200)]
    states = MAX_STEPS // len(events) + 10
    formula = " ".join(f"s{number} [ default s{(number + 1) % states} ]" for number in range(states))
    certificate = certificate_of(compile_property("fsm", formula, events, ORIGIN))
    assert (certificate.proved, certificate.wrong) == (False, False)
    assert certificate.text == "there are too many cases to check: tested, not proved"


def test_an_expression_that_is_too_large_is_not_proved() -> None:
    certificate = certify(
        "ere", "(a|b)* a (a|b)^30 c", ["a", "b", "c"], AutomatonTables(0, [[0, 0, 0]], [()])
    )
    assert (certificate.proved, certificate.wrong) == (False, False)
    assert certificate.text == "there are too many cases to check: tested, not proved"


SPECIFICATION = """
guard() {
    event a() /x std_msgs/Bool '{}' { }
    event b() /y std_msgs/Bool '{}' { }
    ltl: [](a => o (!a U b))
    @violation { ROS_WARN("no"); }
    mtl: once[0,1s] a
    @violation { ROS_WARN("no"); }
}
"""


def certified() -> tuple[dict[str, list[str]], list[str]]:
    compiled = compiled_from({"guard.rv": SPECIFICATION}, standard_definitions())
    lines, wrong = certificates_of(compiled.specifications)
    return lines, [str(finding) for finding in wrong]


def test_each_property_has_a_certificate() -> None:
    lines, wrong = certified()
    proved, tested = lines["guard"]
    assert proved.startswith("ltl: proved: ")
    assert tested == "mtl: it has time bounds: tested, not proved"
    assert not wrong


def test_a_wrong_compiler_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_wrong(source: Source) -> FiniteProperty:
        return FiniteProperty(source, ("violation", "validation"), Automaton(0, ((0, 0),), ((),)))

    monkeypatch.setattr(catalogue, "LOGICS", {**catalogue.LOGICS, "ltl": Logic(compile_wrong)})
    assert certified()[1] == [
        "guard.rv:5:10: error: the automaton of this property differs from its formula: after a a the automaton says"
        f" nothing, the definition violation; {DEFECT}"
    ]


def test_the_certifier_shares_no_code_with_the_compilers() -> None:
    receiving = {"properties.py", "steps.py", "scripted_module.py"}
    pure = 0
    folder = Path(rosmop.certify.__file__).parent
    for file in folder.glob("*.py"):
        imported = {
            node.module or ""
            for node in ast.walk(ast.parse(file.read_text()))
            if isinstance(node, ast.ImportFrom)
        }
        ours = {module for module in imported if module.startswith(("rosmop", "roswire"))} - {
            "roswire.counted"
        }
        assert "rosmop.fast.wasm" not in ours, file
        if file.name not in receiving:
            assert all(module.startswith("rosmop.certify") for module in ours), file
            pure += bool(ours)
    assert pure > 3, "the rule looks at imports that there are"


@pytest.mark.parametrize(
    ("text", "nanoseconds"), [("0", 0), ("2s", 2 * 10**9), (".5 ms", 500_000), ("1.5m", 90 * 10**9)]
)
def test_durations(text: str, nanoseconds: int) -> None:
    assert WordReader(text, ["."]).duration() == nanoseconds


@pytest.mark.parametrize("text", ["", "a", "inf", "NaN", "Infinity", ".", ". 5"])
def test_other_words_are_not_durations(text: str) -> None:
    with pytest.raises(UnsupportedFormulaError, match="where a duration is expected"):
        WordReader(text, ["."]).duration()


@pytest.mark.complete
@pytest.mark.parametrize(
    ("logic", "syntax"), [("ltl", ltl.SYNTAX), ("ptltl", ptltl.SYNTAX), ("mtl", mtl.SYNTAX)]
)
def test_every_operator_that_a_logic_reads_is_certified(logic: str, syntax: Syntax) -> None:
    later = (
        {*mtl.FUTURE} if logic == "mtl" else set[str]()
    )  # they need bounds of time, which nothing certifies
    formulas = [f"{sign} a" for sign in syntax.unary if sign not in later]
    formulas += [f"a {sign} b" for level in syntax.levels for sign in level.operators if sign not in later]
    assert len(formulas) > 8
    for formula in formulas:
        whole = f"o ({formula})" if logic == "ltl" else formula  # a formula of ltl is about the future
        certificate = certificate_of(compile_property(logic, whole, EVENTS, ORIGIN))
        assert certificate.proved, (
            f"{formula}: define the operator in rosmop/certify, too: {certificate.text}"
        )


def test_every_logic_is_certified_or_named_as_not_certified() -> None:
    assert {*catalogue.LOGICS} == {*_CHECKS} | {*_NO_AUTOMATON}
