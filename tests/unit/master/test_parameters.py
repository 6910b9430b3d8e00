"""The mirror of the parameters is ROSMaster's tree, step by step: compared with rosmaster's own code."""

import json
import subprocess
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.master.call import LimitReachedError
from appliance.master.parameters import ParameterMirror, measure
from appliance.ros.errors import ProtocolError
from tests.support.nodes import PYTHON

ORACLE = """
import json, sys
from rosmaster.paramserver import ParamDictionary
for line in sys.stdin:
    tree = ParamDictionary(None)
    for do, key, value in json.loads(line):
        try:
            tree.set_param(key, value) if do == "set" else tree.delete_param(key)
        except (KeyError, TypeError):
            pass
    print(json.dumps(tree.parameters), flush=True)
"""
PART = st.sampled_from(["a", "b", "c"])
KEY = st.lists(PART, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
VALUE = st.recursive(
    st.one_of(st.integers(0, 9), st.text("xy", max_size=3), st.booleans()),
    lambda inner: st.one_of(st.lists(inner, max_size=2), st.dictionaries(PART, inner, max_size=3)),
    max_leaves=6,
)
STEP = st.one_of(st.tuples(st.just("set"), KEY, VALUE), st.tuples(st.just("delete"), KEY, st.none()))


@pytest.fixture(scope="module")
def oracle() -> Any:
    """rosmaster's ParamDictionary, run by the interpreter it is installed for."""
    with subprocess.Popen(
        [PYTHON, "-c", ORACLE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(STEP, max_size=12))
def test_the_mirror_is_what_rosmaster_has(oracle: Any, steps: list[Any]) -> None:
    """After any sequence of settings and deletions both trees are equal, and the weight is that of the tree."""
    oracle.stdin.write(json.dumps(steps) + "\n")
    oracle.stdin.flush()
    mirror = ParameterMirror({}, lambda: None)
    for do, key, value in json.loads(json.dumps(steps)):
        if do == "set":
            mirror.set(key, value)
        else:
            mirror.delete(key)
    assert mirror.tree == json.loads(oracle.stdout.readline())
    assert mirror.weight == measure(mirror.tree)[0]


def test_what_would_be_too_much_is_refused_before_it_is_set() -> None:
    """All parameters together are bounded; what is deleted makes room."""
    mirror = ParameterMirror({}, lambda: None, bytes_limit=1000)
    mirror.check("/a", "x" * 500)
    mirror.set("/a", "x" * 500)
    with pytest.raises(LimitReachedError, match="the limit is 1000"):
        mirror.check("/b", "x" * 500)
    mirror.delete("/a")
    mirror.check("/b", "x" * 500)


def test_key_and_value_together_are_bounded_in_depth() -> None:
    """ROSMaster answers recursively: what it could not tell any more never gets there."""
    mirror = ParameterMirror({}, lambda: None, depth_limit=5)
    mirror.check("/a/b/c", {"d": [1]})
    with pytest.raises(ProtocolError, match="nest deeper"):
        mirror.check("/a/b/c", {"d": [[1]]})
    with pytest.raises(ProtocolError, match="nil"):
        mirror.check("/a", {"b": [None]})
