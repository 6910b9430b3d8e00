"""Join the modules of the witness to the file `witness.py`, which the robot's computer runs without the appliance."""

import ast
from collections import defaultdict
from importlib.resources import files

_PACKAGE = "appliance.features.standby.witness"
_PARTS = (
    "errors", "protocol", "settings", "lease_file", "lease_rules", "request_gate", "follower", "firewall_rules",
    "firewall", "idle_connections", "enforcement", "serving", "following",
)  # fmt: skip
"""In the order of their imports. `program` comes last."""
_START = '\n\nif __name__ == "__main__":\n    sys.exit(main(sys.argv[1:]))\n'


def witness_program() -> str:
    """Return the text of the program: one list of imports, then the contents of all modules."""
    parts = {name: _Part(name) for name in (*_PARTS, "program")}
    head = f"#!/usr/bin/env python3\n{parts['program'].docstring}\n\n{_imports(list(parts.values()))}"
    bodies = (f"# ---- {name.replace('_', ' ')}\n\n\n{part.body}" for name, part in parts.items())
    return "\n\n\n".join([head, *bodies]) + _START


class _Part:
    """A module without its imports from the other modules, whose names the program has anyway."""

    def __init__(self, name: str) -> None:
        text = files(_PACKAGE).joinpath(f"{name}.py").read_text("utf-8")
        docstring, *statements = ast.parse(text).body
        self.docstring = ast.get_source_segment(text, docstring)
        self.imports = [node for node in statements if isinstance(node, ast.Import | ast.ImportFrom)]
        last = max(node.end_lineno or 0 for node in (docstring, *self.imports))
        self.body = "\n".join(text.splitlines()[last:]).strip()


def _imports(parts: list[_Part]) -> str:
    modules, names = set[str](), defaultdict[str, set[str]](set)
    for node in (node for part in parts for node in part.imports):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif node.module and not node.module.startswith(f"{_PACKAGE}."):
            names[node.module] |= {alias.name for alias in node.names}
    rows = [f"import {module}" for module in sorted(modules)]
    return "\n".join(
        [*rows, *(f"from {module} import {', '.join(sorted(names[module]))}" for module in sorted(names))]
    )
