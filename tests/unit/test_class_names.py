"""Each public class name is used once in the product, so that it identifies the class."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("appliance", "rosmop", "roswire", "fleet/rosrv_fleet")


def test_no_public_class_name_is_used_twice() -> None:
    """A name without an underscore has one definition in the appliance, the language and the collector."""
    places = defaultdict(list)
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        relative = path.relative_to(ROOT)
        if "tests" in relative.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(f"{relative}:{node.lineno}")
    assert len(places) > 1000
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
