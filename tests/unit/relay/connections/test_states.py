import ast
from pathlib import Path

import pytest

import appliance.relay.connections

_FOLDER = Path(appliance.relay.connections.__file__).parent
_MAX = 9


@pytest.mark.parametrize(
    ("file", "name"), [("relayed_topic.py", "RelayedTopic"), ("upstream.py", "PublisherConnection")]
)
def test_a_state_is_an_enum_and_few_attributes(file: str, name: str) -> None:
    """Attributes that methods set again can combine, and most combinations should be impossible."""
    tree = ast.parse((_FOLDER / file).read_text())
    [found] = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    methods = [node for node in found.body if isinstance(node, ast.FunctionDef) and node.name != "__init__"]
    state = {
        node.attr
        for method in methods
        for node in ast.walk(method)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and ast.unparse(node.value) == "self"
    }
    [enum] = {one for one in state if one.strip("_") == "state"}
    assert len(state - {enum}) <= _MAX, sorted(state)
