"""Join the modules of the witness to the file `witness.py`, which the robot's computer runs without the appliance."""

import re
from collections import defaultdict
from importlib.resources import files

_PACKAGE = "appliance.features.standby.witness"
_PARTS = (
    "errors", "protocol", "settings", "lease_file", "lease_rules", "request_gate", "follower", "firewall_rules",
    "firewall", "idle_connections", "enforcement", "serving", "following",
)  # fmt: skip
"""In the order of their imports. `program` comes last."""
_DOCSTRING = re.compile(r'""".+?"""$', re.DOTALL | re.MULTILINE)
_IMPORT = re.compile(
    r"^(?:import (?P<module>[\w.]+)|from (?P<source>[\w.]+) import (?P<names>[\w, ]+|\([^()]+\)))$",
    re.MULTILINE,
)
"""As ruff writes them. `ast` of Debian 12's Python fails at times when a collection of garbage falls into it."""
_NAME = re.compile(r"\w+")
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
        docstring = _DOCSTRING.match(text)
        assert docstring is not None, name  # noqa: S101  a test joins them all
        self.docstring = docstring[0]
        self.imports = list(_IMPORT.finditer(text))
        self.body = text[max(found.end() for found in (docstring, *self.imports)) :].strip()


def _imports(parts: list[_Part]) -> str:
    modules, names = set[str](), defaultdict[str, set[str]](set)
    for row in (row for part in parts for row in part.imports):
        if row["module"]:
            modules.add(row["module"])
        elif not row["source"].startswith(f"{_PACKAGE}."):
            names[row["source"]] |= set(_NAME.findall(row["names"]))
    rows = [f"import {module}" for module in sorted(modules)]
    return "\n".join(
        [*rows, *(f"from {module} import {', '.join(sorted(names[module]))}" for module in sorted(names))]
    )
