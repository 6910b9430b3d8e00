"""The lints find a kind of mistake however it is written, and leave honest code alone."""

from pathlib import Path

from rosmop.check.sources import compiled_from
from rosmop.tests.acting import definitions
from rosmop.tests.transcripts import Case, table

KINDS = {
    "NaN": ("NaN",),
    "lost": ("is lost, because",),
    "every": ("drops every message",),
    "stale": ("as it was, so other topics",),
    "ends": ("only ends",),
    "jump": ("as if it had driven on", "as if the robot had driven on"),
}


SHIPPED = sorted((Path(__file__).parents[3] / "monitors").rglob("*.rv"))


def found(*files: Path) -> list[str]:
    texts = {str(file): file.read_text() for file in files}
    warnings = [warning.text for warning in compiled_from(texts, definitions()).warnings]
    words = [word for kind in KINDS.values() for word in (*kind, "are not checked")]
    return [text for text in warnings if any(word in text for word in words)]


def test_no_shipped_monitor_has_such_a_warning() -> None:
    assert len(SHIPPED) > 15
    assert [text for file in SHIPPED for text in found(file)] == []


@table(Path(__file__).parent / "flow.txt")
def test_a_lint_finds_its_kind_and_no_other(case: Case) -> None:
    warnings = compiled_from({"x.rv": case.text}, definitions()).warnings
    texts = [warning.text for warning in warnings]
    kinds = [kind for kind, words in KINDS.items() if any(word in text for text in texts for word in words)]
    assert tuple(kinds or ["accepted"]) == case.expected, warnings
