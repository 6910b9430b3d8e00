from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.audit.search.search import export
from appliance.channel.answers.graph_answers import Registration
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.features.policy_tools.policy_input import period_since
from appliance.features.policy_tools.routes import policy_uses
from tests.support.answers import example
from tests.support.audit import decision, settle
from tests.support.engines import open_log

TEXT = "[Nodes]\ndefault = *\n[Publishers]\n/cmd_0 = 10.0.0.0\n/cmd_1 = 10.0.0.1\n/cmd_2 = 10.0.0.9\n/scan = 10.0.0.7\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "audit.db"
    made = open_log(path)
    for number in (0, 1):
        made.record(decision(made, number))
    assert settle(made) is None
    made.close()
    return path


def states(log: Path, most: int = 10) -> tuple[bool, dict[str, str]]:
    current = example(PolicyKnown, revision=7, text=TEXT, file="p.ini")
    uses = policy_uses(
        log, current, [Registration("10.0.0.7", "/laser", "registerPublisher", "/scan")], 0, most
    )
    return uses.whole, {row.rule.key: row.state for row in uses.rules}


def test_each_rule_has_its_use_by_recorded_requests_and_by_registrations_of_now(log: Path) -> None:
    assert states(log) == (
        True,
        {"default": "used", "/cmd_0": "used", "/cmd_1": "used", "/cmd_2": "unused", "/scan": "used"},
    )


def test_with_more_records_than_are_read_the_newest_count_and_the_unseen_is_unknown(log: Path) -> None:
    whole, found = states(log, most=1)
    assert not whole
    assert (found["/cmd_0"], found["/cmd_1"], found["/cmd_2"]) == ("unknown", "used", "unknown")


def test_a_period_notes_its_removed_records(log: Path) -> None:
    def from_five(wanted: Any) -> Any:
        return (entry._replace(sequence=entry.sequence + 4) for entry in export(log, wanted))

    appliance: Any = SimpleNamespace(host_in_words=str)
    for read, since, noted in (
        (partial(export, log), None, []),
        (from_five, None, ["earlier records are removed from the log"]),
        (from_five, 1, ["earlier records of that time are removed from the log"]),
        (from_five, 2**62, []),
    ):
        assert list(period_since(read, since, 0).notes(appliance, "learned")) == noted
