"""The check of `ptltl` automata is proved sound in Coq (`proofs/past.v`); the Python at every load says the same."""

import shutil
import subprocess
from pathlib import Path
from random import Random

import pytest

from appliance.rosmop.certify import text
from appliance.rosmop.certify.check import Tables, certify
from tests.support.requirements import need_program
from tests.support.spin import MODEL
from tests.unit.rosmop.certify.test_certify import broken, properties, tables_of

PROOFS = MODEL.parent


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what Coq has proved and extracted, and the program that asks it."""
    folder = tmp_path_factory.mktemp("past")
    for name in ("past.v", "past_driver.ml"):
        shutil.copy(PROOFS / name, folder)
    said = _run(folder, need_program("coqc", "coq"), "past.v")
    assert (
        said.strip() == "Closed under the global context"
    )  # it stands on no axiom, and nothing is left to prove
    compiler = need_program("ocamlfind", "ocaml-findlib")
    _run(folder, compiler, "ocamlopt", "-o", "past", "past.mli", "past.ml", "past_driver.ml")
    return folder


def _run(folder: Path, *command: str, given: str = "") -> str:
    ran = subprocess.run(command, cwd=folder, input=given, check=False, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def _written(node: text.Node, events: list[str]) -> list[str]:
    """Operator first."""
    if node[0] == "event":
        return ["event", str(events.index(str(node[1])))]
    words = [str(node[0]).replace(" ", "-")]
    for operand in node[1:]:
        assert isinstance(operand, tuple)
        words += _written(operand, events)
    return words


def _line(formula: str, events: list[str], tables: Tables) -> str:
    rows = [target for row in tables.table for target in row]
    verdicts = [int(verdict == ("validation",)) for verdict in tables.verdicts]
    numbers = [len(events), tables.initial, len(tables.table), *rows, *verdicts]
    return " ".join([*map(str, numbers), *_written(text.formula(formula, events, text.PTLTL), events)])


def test_the_check_at_every_load_is_the_proved_one(proved: Path) -> None:
    """On a thousand random formulas, with the automata of the compiler and with broken ones."""
    random = Random(4)  # noqa: S311  no secret
    lines, answers = [], []
    for compiled in properties("ptltl", 5, 1000):
        events, tables = list(compiled.events), tables_of(compiled)
        for one in (tables, broken(random, tables)):
            if () in one.verdicts:
                continue  # a state that tells nothing is none of the logic's, and cannot be written here
            lines.append(_line(compiled.formula, events, one))
            answers.append(certify("ptltl", compiled.formula, events, one).proved)
    said = [answer == "1" for answer in _run(proved, "./past", given="\n".join(lines) + "\n").split()]
    assert [line for line, ours, theirs in zip(lines, answers, said, strict=True) if ours is not theirs] == []
    assert said.count(True) >= 1000
    assert said.count(False) >= 300
