import ast
import re
from collections.abc import Collection

import pytest

from lab.proofs.spin import FOLLOWER, INSERTION, LEASE, Model
from lab.tests.proofs import test_follower, test_insertion_mutants, test_lease_mutants

ROOT = INSERTION.path.parents[2]
_NAME = re.compile(r"^(?:/\*|  +/\*|) *= (appliance/\S+\.py) (\w+(?:\.\w+)?)", re.MULTILINE)


def named(model: Model) -> list[tuple[str, str]]:
    return sorted(set(_NAME.findall(model.path.read_text())))


@pytest.mark.parametrize(("path", "name"), named(INSERTION) + named(LEASE) + named(FOLLOWER))
def test_the_model_names_existing_code(path: str, name: str) -> None:
    inside: list[ast.stmt] = ast.parse((ROOT / path).read_text()).body
    for part in name.split("."):
        found = [
            one
            for one in inside
            if isinstance(one, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and one.name == part
        ]
        assert found, f"{path} has no {name}"
        inside = found[0].body


@pytest.mark.parametrize(
    ("model", "others"),
    [(INSERTION, {"Rest"}), (LEASE, {"Time", "Faults", "Observer", "LastFault"})],
    ids=["insertion", "lease"],
)
def test_every_process_names_what_it_models(model: Model, others: set[str]) -> None:
    text = model.path.read_text()
    parts = re.split(r"^proctype (\w+)", text, flags=re.MULTILINE)
    heads = [part.rpartition("\n}\n")[2] for part in parts[0:-1:2]]
    bodies = [part.partition("\n}\n")[0] for part in parts[2::2]]
    processes = dict(zip(parts[1::2], zip(heads, bodies, strict=True), strict=True))
    without = {name for name, texts in processes.items() if "= appliance/" not in "".join(texts)}
    assert without == others
    assert len(named(model)) == len(set(re.findall(r"= (appliance/\S+ \S+)", text)))


@pytest.mark.parametrize(
    ("model", "mutants"),
    [
        (INSERTION, test_insertion_mutants.MUTANTS),
        (LEASE, test_lease_mutants.MUTANTS),
        (FOLLOWER, test_follower.MUTANTS),
    ],
    ids=["insertion", "lease", "follower"],
)
def test_every_mutant_is_tried(model: Model, mutants: Collection[str]) -> None:
    assert set(re.findall(r"MUTANT_(\w+)", model.path.read_text())) == set(mutants)
