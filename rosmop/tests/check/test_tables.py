import re
from contextlib import suppress
from pathlib import Path

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import act, action, definitions, load, message
from rosmop.tests.both_ways import BothWays
from rosmop.tests.stories import Step, Story, tell
from rosmop.tests.transcripts import Case, table

TABLES = Path(__file__).parent


@table(TABLES / "findings.txt")
def test_the_check_reports_these_findings_at_these_places(case: Case) -> None:
    try:
        found = MonitorSet.of(compiled_from({"x.rv": case.text}, definitions())).warnings
    except SpecificationError as error:
        found = error.findings
    lines = [f"{one.position.line}:{one.position.column} {one.severity}: {one.text}" for one in found]
    assert tuple(lines or ["accepted"]) == case.expected


@table(TABLES / "values.txt")
def test_an_action_prints_what_cpp_prints(case: Case) -> None:
    outcome = act(case.text, before=case.beside)
    lines = " ".join(line.text for line in outcome.log)
    fault = "".join(f"fault: {one.text}" for one in outcome.faults)
    assert (fault or lines,) == case.expected
    assert not fault or (outcome.result, lines) == ("dropped", "")
    for text in (case.text, unfolded(case)):
        with suppress(SpecificationError):  # a size or a case label must stay a constant
            BothWays(action(text, before=case.beside)).check([message("std_msgs/Int32")], "/t", 1_500_000_000)


def unfolded(case: Case) -> str:
    """Add `x`, which is 0, to the numbers, so that no value is computed before a message."""
    if '"' in case.source:
        return case.text
    return case.frame.replace("…", re.sub(r"(?<![\w.])(\d+(\.\d+)?)(?![\w.])", r"(\1 + x)", case.source))


@table(TABLES / "messages.txt")
def test_an_event_reads_and_changes_its_message(case: Case) -> None:
    for line in case.expected:
        given, _, expected = line.partition(" -> ")
        step = Step(f"0s /t {given}".replace(" (zero)", ""), "", ())
        [(_, lines)] = tell(Story("", {}, case.text, (step,)))
        assert "; ".join(map(str.strip, lines)) == expected, given


@table(TABLES / "enforcement.txt")
def test_the_line_about_enforcement_says_how_or_what_it_would_take(case: Case) -> None:
    [monitor] = load(case.text).monitors
    assert (monitor.properties[0].code.enforcement,) == case.expected
