import json
import random
import subprocess

import pytest

from roswire.parameter_tree import Tree, names_in

pytestmark = pytest.mark.nightly

KEYS = ("a", "b1", "c_d", "/e", "~f", "~", "g/h", "i/", "/", "")
_ASK = """
import json, sys
from rosmaster.paramserver import _get_param_names
for line in sys.stdin:
    names = []
    _get_param_names(names, "/", json.loads(line))
    print(json.dumps(names))
"""


def some_tree(chance: random.Random, depth: int) -> Tree:
    keys = chance.sample(KEYS, chance.randrange(5))
    return {key: some_tree(chance, depth - 1) if depth and chance.random() < 0.4 else 1 for key in keys}


def test_names_are_those_that_rosmaster_tells() -> None:
    chance = random.Random(1)  # noqa: S311  not a secret
    trees = [some_tree(chance, 4) for _ in range(500)]
    asked = "".join(f"{json.dumps(tree)}\n" for tree in trees)
    program = ["/usr/bin/python3", "-s", "-c", _ASK]
    done = subprocess.run(program, input=asked, capture_output=True, text=True, check=True, timeout=60)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [list(names_in(tree)) for tree in trees] == told
