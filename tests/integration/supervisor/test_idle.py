"""What the processes of an appliance have loaded that nobody has asked anything yet: as the kernel sees it."""

import re
from pathlib import Path
from typing import Final

from tests.support.appliance import Appliance

COMPILED: Final = {
    "pydantic_core",
    "cryptography",
    "yaml",
    "numpy",
    "wasmtime",
    "uvloop",
    "httptools",
    "_sqlite3",
}
"""Libraries whose compiled part shows in the memory of who has imported them."""

MAY_HAVE: Final = {
    "supervisor": {"pydantic_core", "yaml", "_sqlite3"},
    "signer": {"cryptography"},
    "relay": set[str](),
    "control": {"cryptography", "yaml", "uvloop", "httptools", "_sqlite3"},
    "api": {"cryptography", "uvloop", "httptools"},
}


def loaded(pid: int) -> set[str]:
    """Those of `COMPILED` that a process has."""
    files = set(re.findall(r"\S+\.so\S*$", Path(f"/proc/{pid}/maps").read_text(), re.MULTILINE))
    return {one for one in COMPILED if any(re.search(rf"/{one}[/.]", file) for file in files)}


def test_who_is_not_asked_loads_nothing_for_it() -> None:
    """Each process has its own libraries; the first call of REST brings those that read and describe calls."""
    with Appliance() as appliance:
        rows = {role: row["pid"] for role, row in appliance.processes().items()}
        assert {role: loaded(rows[role]) - may for role, may in MAY_HAVE.items()} == {
            role: set() for role in MAY_HAVE
        }
        assert appliance.rest().get("/v1/status").status == 200
        assert "pydantic_core" in loaded(rows["api"])
