import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from appliance.features.standby.witness import one_file
from appliance.features.standby.witness.one_file import witness_program

SOURCE = witness_program()


@pytest.mark.nightly
def test_it_runs_on_python_3_5(tmp_path: Path) -> None:
    ast.parse(SOURCE, feature_version=(3, 5))
    program = tmp_path / "witness.py"
    program.write_text(SOURCE)
    command = [str(Path(sys.executable).with_name("vermin")), "--no-tips", "--target=3.5-", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_its_patterns_compile_on_python_3_5() -> None:
    """Before 3.11 the `re` module has no possessive quantifiers, and the witness would end at its start."""
    newer = re.compile(r"[*+?}]\+|\(\?>")
    assert newer.search(r"\d++") is not None
    patterns = [
        node.args[0].value
        for node in ast.walk(ast.parse(SOURCE))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func).startswith("re.")
        and isinstance(node.args[0], ast.Constant)
        and isinstance(node.args[0].value, str)
    ]
    assert patterns
    assert [pattern for pattern in patterns if newer.search(pattern)] == []


def test_it_imports_only_the_standard_library() -> None:
    imported = {
        name.partition(".")[0]
        for node in ast.walk(ast.parse(SOURCE))
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert imported <= sys.stdlib_module_names


def test_it_has_every_module() -> None:
    modules = {path.stem for path in Path(one_file.__file__).parent.glob("*.py")} - {"__init__", "one_file"}
    headings = {
        line[len("# ---- ") :].replace(" ", "_") for line in SOURCE.splitlines() if line.startswith("# ---- ")
    }
    assert headings == modules


def test_no_name_of_a_module_replaces_a_name_of_another() -> None:
    names = Counter(
        name.id if isinstance(name, ast.Name) else name.name
        for node in ast.parse(SOURCE).body
        for name in (
            [name for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            if isinstance(node, ast.Assign)
            else [node]
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
            else []
        )
    )
    assert names["WitnessFollower"] == 1
    assert [name for name, times in names.items() if times > 1] == []
