from pathlib import Path

import pytest

from benchmarks import dejavu, rv_monitor


def test_a_comparison_of_nothing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dejavu.main(tmp_path) == 2
    assert "give a clone of DejaVu's repository" in capsys.readouterr().err
    monkeypatch.setattr(rv_monitor, "automata", lambda _checkout, _javacc, formulas: [""] * len(formulas))
    assert rv_monitor.main([str(tmp_path), "javacc.jar", "2"]) == 2
    assert "makes no automaton" in capsys.readouterr().err
