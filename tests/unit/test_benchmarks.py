import re
from pathlib import Path

import pytest

from benchmarks import dejavu, rv_monitor
from tests.support.sources import ROOT, files_of_tests


def test_a_comparison_of_nothing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dejavu.main(tmp_path) == 2
    assert "give a clone of DejaVu's repository" in capsys.readouterr().err
    monkeypatch.setattr(rv_monitor, "automata", lambda _checkout, _javacc, formulas: [""] * len(formulas))
    assert rv_monitor.main([str(tmp_path), "javacc.jar", "2"]) == 2
    assert "makes no automaton" in capsys.readouterr().err


def test_each_program_has_a_reader() -> None:
    """A page, a test or another program that has one names it: a figure without a reader is not measured."""
    programs = {path.stem: path.read_text() for path in (ROOT / "benchmarks").glob("*.py")}
    pages = [ROOT / "benchmarks" / "RESULTS.md", *(ROOT / "docs").rglob("*.md")]
    tests = [path for path in files_of_tests() if path.name != "test_benchmarks.py"]
    text = "\n".join(path.read_text() for path in (*pages, *tests))
    named = {
        one or other for one, other in re.findall(r"\bbenchmarks[./](\w+)|`(\w+)\.py", text)
    } & programs.keys()
    while more := {
        name
        for name in programs.keys() - named
        if any(re.search(rf"\bbenchmarks(\.| import .*\b){name}\b", programs[other]) for other in named)
    }:
        named |= more
    assert sorted(programs.keys() - named) == []
