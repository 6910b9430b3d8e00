import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from lab.proofs.spin import INSERTION
from rosmop.certify import formula_reader
from rosmop.certify.check import AutomatonTables, StateMachineFollower, Verdicts, certify
from rosmop.tests.certify.test_certify import broken, properties, tables_of
from tests.support.requirements import need_program

PROOFS = INSERTION.path.parent


def _run(folder: Path, *command: str, given: str = "") -> str:
    ran = subprocess.run(command, cwd=folder, input=given, check=False, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def _proved(folder: Path, name: str) -> Path:
    for file in (f"{name}.v", f"{name}_driver.ml"):
        shutil.copy(PROOFS / file, folder)
    said = _run(folder, need_program("coqc", "coq"), f"{name}.v")
    # each theorem is free of axioms, and no proof is open
    assert set(said.splitlines()) == {"Closed under the global context"}
    compiler = need_program("ocamlfind", "ocaml-findlib")
    _run(folder, compiler, "ocamlopt", "-o", name, f"{name}.mli", f"{name}.ml", f"{name}_driver.ml")
    return folder / name


@pytest.fixture(scope="module")
def past(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _proved(tmp_path_factory.mktemp("past"), "past")


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _proved(tmp_path_factory.mktemp("words"), "words")


def _numbers(*numbers: int) -> str:
    return " ".join(map(str, numbers))


def _automaton(events: list[str], tables: AutomatonTables, verdict: Callable[[Verdicts], int]) -> str:
    rows = [target for row in tables.table for target in row]
    verdicts = map(verdict, tables.verdicts)
    return _numbers(len(events), tables.initial, len(tables.table), *rows, *verdicts)


def _written(node: formula_reader.Node, events: list[str]) -> str:
    kind = str(node[0])
    if kind == "event":
        return f"event {events.index(str(node[1]))}"
    operands = [_written(operand, events) for operand in node[1:] if isinstance(operand, tuple)]
    if kind == "power":
        return f"sequence {operands[0]} " * int(str(node[2])) + "epsilon"
    return " ".join([kind.replace(" ", "-"), *operands])


def _past(formula: str, events: list[str], tables: AutomatonTables) -> str:
    read = formula_reader.formula(formula, events, formula_reader.PTLTL)
    return f"{_automaton(events, tables, (('violation',), ('validation',)).index)} {_written(read, events)}"


def _expression(formula: str, events: list[str], tables: AutomatonTables) -> str:
    automaton = _automaton(events, tables, ((), ("match",), ("fail",)).index)
    return f"{automaton} ere {_written(formula_reader.expression(formula, events), events)}"


def _machine(formula: str, events: list[str], tables: AutomatonTables) -> str:
    machine = StateMachineFollower(formula, events)
    states = [machine.initial]
    for state in states:
        states += dict.fromkeys(
            after for after in (machine.step(state, event) for event in events) if after not in states
        )
    verdicts: list[Verdicts] = [machine.verdicts(state) for state in states]
    known = list(dict.fromkeys([*tables.verdicts, *verdicts]))
    rows = [states.index(machine.step(state, event)) for state in states for event in events]
    numbers = map(known.index, verdicts)
    return f"{_automaton(events, tables, known.index)} fsm {_numbers(0, len(states), *rows, *numbers)}"


def _compare(program: Path, logic: str, line: Callable[[str, list[str], AutomatonTables], str]) -> None:
    random = Random(4)  # noqa: S311  no secret
    lines, answers = [], []
    for compiled in properties(logic, 5, 1000):
        events, tables = list(compiled.events), tables_of(compiled)
        for one in (tables, broken(random, tables)):
            if logic == "ptltl" and () in one.verdicts:
                continue  # a state without a verdict does not exist in the logic, and cannot be written here
            lines.append(line(compiled.formula, events, one))
            answers.append(certify(logic, compiled.formula, events, one).proved)
    said = [
        answer == "1" for answer in _run(program.parent, str(program), given="\n".join(lines) + "\n").split()
    ]
    assert [line for line, ours, theirs in zip(lines, answers, said, strict=True) if ours is not theirs] == []
    assert said.count(True) >= 1000
    assert said.count(False) >= 300


def test_the_check_of_ptltl_agrees_with_the_proof(past: Path) -> None:
    _compare(past, "ptltl", _past)


def test_the_check_of_ere_agrees_with_the_proof(words: Path) -> None:
    _compare(words, "ere", _expression)


def test_the_check_of_fsm_agrees_with_the_proof(words: Path) -> None:
    _compare(words, "fsm", _machine)
