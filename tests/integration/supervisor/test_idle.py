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

MAY_HAVE: Final = {
    "supervisor": {"pydantic_core", "yaml", "_sqlite3"},
    "signer": {"cryptography"},
    "relay": set[str](),
    "control": {"pydantic_core", "cryptography", "yaml", "uvloop", "httptools", "_sqlite3"},
    "api": {"pydantic_core", "cryptography", "uvloop", "httptools"},
}


def loaded(pid: int) -> set[str]:
    files = set(re.findall(r"\S+\.so\S*$", Path(f"/proc/{pid}/maps").read_text(), re.MULTILINE))
    return {one for one in COMPILED if any(re.search(rf"/{one}[/.]", file) for file in files)}


def test_idle_processes_load_only_their_libraries() -> None:
    with Appliance() as appliance:
        rows = {role: row["pid"] for role, row in appliance.processes().items()}
        assert {role: loaded(rows[role]) - may for role, may in MAY_HAVE.items()} == {
            role: set() for role in MAY_HAVE
        }
        assert appliance.rest().get("/v1/status").status == 200
        assert "pydantic_core" in loaded(rows["api"])
