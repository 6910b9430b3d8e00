"""`--other`: both appliances of a pair are one history, from the files of their logs."""

import json
from pathlib import Path
from typing import Any

import pytest
import typer

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import rfc3339
from appliance.base import clock
from appliance.cli.connection.audit_over_rest import RestLog
from appliance.features.logbook.log_source import logs_of
from tests.support.audit import settle
from tests.support.command import rosrv
from tests.support.engines import ByHand
from tests.support.memory_rest import page, rest_client
from tests.support.virtual_clock import VirtualClock

BEGIN = 1_800_000_000
HISTORY: tuple[tuple[str, int, str, str, dict[str, Any]], ...] = (
    ("a", 0, "took over", "", {"appliance": "a", "other": "b"}),
    ("a", 10, "monitor disabled", "speed", {"who": "ann", "earlier": "enabled"}),
    ("a", 20, "authority handed over", "base", {"earlier": "nobody", "holder": "10.0.0.5", "who": "ann"}),
    ("a", 30, "handed over", "", {"appliance": "a", "to": "b"}),
    ("b", 31, "took over", "", {"appliance": "b", "other": "a"}),
    ("b", 40, "authority handed over", "base", {"earlier": "nobody", "holder": "10.0.0.6", "who": "bob"}),
    ("b", 50, "monitor enabled", "speed", {"who": "bob", "earlier": "disabled"}),
)


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("pair")
    with clock.using(time := VirtualClock(wall=BEGIN)):
        logs = {}
        for name in ("a", "b"):
            path = folder / name / "control" / "audit.db"
            path.parent.mkdir(parents=True)
            logs[name] = AuditLog(path, drive=ByHand)
        at = 0
        for name, seconds, event, what, detail in HISTORY:
            time.advance(seconds - at)
            at, log = seconds, logs[name]
            log.record(
                AuditRecord(
                    id=log.ids.next(), time=clock.wall_ns(), event=event, resource=what or None, detail=detail
                )
            )
            assert settle(log) is None
        for log in logs.values():
            assert log.close() is None
        return {name: str(folder / name) for name in logs}


@pytest.mark.nightly  # it asks the admin socket for the interfaces of now
def test_both_logs_are_one_report(states: dict[str, str], tmp_path: Path) -> None:
    page = tmp_path / "both.html"
    words = (
        "report", "interventions", "--state", states["b"], "--other", states["a"], "--until", "2030-01-01",
    )  # fmt: skip
    report = json.loads(rosrv(*words, "--json").stdout)
    assert [(row["appliance"], row["event"]) for row in report["interventions"]] == [
        (name, event) for name, _, event, _, _ in HISTORY
    ]
    (off,) = report["switched_off"]
    assert (off["what"], off["by"], off["ended_by"], off["appliance"]) == ("speed", "ann", "bob", "a")
    assert [(log["name"], log["last"]) for log in report["logs"]] == [("b", 5), ("a", 6)]
    assert rosrv(*words, "--output", str(page)).returncode == 0
    assert "run `rosrv audit verify --other DIR`" in page.read_text()


@pytest.mark.parametrize(
    ("second", "host"), [(25, "10.0.0.5"), (30.5, "10.0.0.5"), (35, None), (45, "10.0.0.6")]
)
def test_a_takeover_ends_who_drove(states: dict[str, str], second: float, host: str | None) -> None:
    at = rfc3339(round((BEGIN + second) * 1e9))
    words = ("who-drove", "--json", "--state", states["a"], "--other", states["b"], "--at", at)
    done = rosrv(*words)
    found = [json.loads(line)["state"] for line in done.stdout.splitlines()]
    assert (found, done.returncode) == ([host] if host else [], 0 if host else 1)


@pytest.mark.parametrize(
    ("other", "reason"), [("a", "the same log as that of --state"), ("none", "is not a state directory")]
)
def test_a_wrong_other_is_refused(states: dict[str, str], other: str, reason: str) -> None:
    found = states.get(other, "/nowhere")
    done = rosrv("report", "interventions", "--state", states["a"], "--other", found)
    assert (done.returncode, reason in done.stderr) == (2, True)


def test_the_other_log_needs_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    over_rest = RestLog(rest_client(lambda _request: page([])))
    with pytest.raises(typer.Exit):
        logs_of(over_rest, tmp_path, "rosrv who-drove")
    assert "--other needs the logs' files" in capsys.readouterr().err
    assert logs_of(over_rest, None, "rosrv who-drove") == {"": over_rest}
