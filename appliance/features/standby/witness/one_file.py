"""Join the modules of the witness to the file `witness.py`, which the robot's computer runs without the appliance."""

from collections import defaultdict
from importlib.resources import files

_PACKAGE = "appliance.features.standby.witness"
_PARTS = (
    "errors", "protocol", "settings", "lease_file", "lease_rules", "request_gate", "follower", "firewall_rules",
    "firewall", "idle_connections", "enforcement", "serving", "following",
)  # fmt: skip
"""In the order of their imports. `program` comes last."""
_QUOTES = '"""'
_START = '\n\nif __name__ == "__main__":\n    sys.exit(main(sys.argv[1:]))\n'


def witness_program() -> str:
    """Return the text of the program: one list of imports, then the contents of all modules."""
    parts = {name: _Part(name) for name in (*_PARTS, "program")}
    head = f"#!/usr/bin/env python3\n{parts['program'].docstring}\n\n{_imports(list(parts.values()))}"
    bodies = (f"# ---- {name.replace('_', ' ')}\n\n\n{part.body}" for name, part in parts.items())
    return "\n\n\n".join([head, *bodies]) + _START


class _Part:
    """A module without its imports from the other modules, whose names the program has anyway.

    Its lines are as ruff writes them. `ast` of Debian 12's Python fails at times when garbage is collected inside it.
    """

    def __init__(self, name: str) -> None:
        text = files(_PACKAGE).joinpath(f"{name}.py").read_text("utf-8")
        _, docstring, code = text.split(_QUOTES, 2)
        self.docstring = f"{_QUOTES}{docstring}{_QUOTES}"
        self.imports, body = list[str](), list[str]()
        lines = iter(code.splitlines())
        for line in lines:
            if line.startswith(("import ", "from ")):
                self.imports.append(line if line[-1] != "(" else line + "".join(iter(lines.__next__, ")")))
                body.clear()
            else:
                body.append(line)
        self.body = "\n".join(body).strip()


def _imports(parts: list[_Part]) -> str:
    modules, names = set[str](), defaultdict[str, set[str]](set)
    for row in (row for part in parts for row in part.imports):
        kind, module, *rest = row.split(maxsplit=3)
        if kind == "import":
            modules.add(module)
        elif not module.startswith(f"{_PACKAGE}."):
            names[module] |= {name.strip("( ") for name in rest[1].split(",")} - {""}
    rows = [f"import {module}" for module in sorted(modules)]
    return "\n".join(
        [*rows, *(f"from {module} import {', '.join(sorted(names[module]))}" for module in sorted(names))]
    )
