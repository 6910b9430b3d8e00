"""`rosrv monitor replay`: run a monitor on recordings and report what it would have done."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from appliance.channel import admin
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.monitor_program import MONITOR
from appliance.features.table import recorded_messages
from rosmop.form.findings import SpecificationError
from rosmop.tool.batch_session import RecordingsOptions, batch_session
from rosmop.tool.options import Bags, BagSets, Folders, On, ReportFile, Resume, ShowProgress, Workers
from rosmop.tool.replay_report import ReplayReport
from rosmop.tool.run_command import run_batch, run_spans
from rosmop.tool.specification_input import Specifications, read_for_recordings, topics_of
from rosmop.tool.terminal import refusal

_MonitorOrFile = Annotated[
    str,
    typer.Argument(
        metavar="MONITOR|FILE",
        help="A monitor of the running appliance, or a file (.rv)",
        show_default=False,
    ),
]
_Since = Annotated[
    str | None,
    typer.Option(
        "--since",
        help="Without --bag: read the flight recorder from this time: 1h (ago), 14:03, a date, or RFC 3339",
        show_default=False,
    ),
]
_Until = Annotated[
    str | None,
    typer.Option("--until", help="Read the flight recorder up to this time", show_default=False),
]
_Topics = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="PATTERN", help="Only these topics; `*` matches anything (repeatable)"),
]
_Most = Annotated[
    int,
    typer.Option(
        "--limit", min=0, metavar="N", help="Largest number of findings for each monitor, topic and kind"
    ),
]
_Margins = Annotated[
    bool, typer.Option("--margins", help="Also show how close each comparison of numbers came (slower)")
]


@speaks
def replay_monitor(
    appliance: Appliance,
    what: _MonitorOrFile,
    *,
    bags: Bags = None,
    sets: BagSets = None,
    since: _Since = None,
    until: _Until = None,
    topics: _Topics = None,
    most: _Most = 10,
    margins: _Margins = False,
    msg: Folders = None,
    workers: Workers = None,
    on: On = None,
    resume: Resume = None,
    report_file: ReportFile = None,
    show_progress: ShowProgress = False,
) -> None:
    """List and count the recorded messages that a monitor alone would have dropped or changed.

    Read bags and MCAP files (--bag, --bags), or the running appliance's flight recorder (--since), with its recordings
    and its memory; gaps are reported. Each recording starts in the monitor's initial state. With --json, print up to
    10,000 findings for each recording, monitor, topic and kind. Exit status 3 if recordings failed.

    Example: rosrv monitor replay safeTrigger --since 1h
    """
    if bool(bags or sets) is (since is not None or until is not None):
        raise MONITOR.usage_error(
            "give --bag FILE or --bags DIR (repeatable), or --since and --until for the flight recorder"
        )
    options = RecordingsOptions(bags or [], sets or [], workers, on, resume, report_file, show_progress)
    report = ReplayReport(most, as_json=appliance.as_json)
    patterns = topics or ["*"]
    try:
        specifications = _specifications(appliance, what, msg or [])
        if options.bags or options.sets:
            with batch_session(MONITOR, options) as session:
                raise typer.Exit(run_batch(session, specifications, report, patterns, margins=margins))
        if workers or on or resume or report_file:
            raise MONITOR.usage_error("--workers, --on, --resume and --report are for bags and MCAP files")
        recorded = recorded_messages()
        if recorded is None:
            raise MONITOR.usage_error("this appliance has no flight recorder: give --bag FILE or --bags DIR")
        with recorded(appliance, since, until, _topics(specifications, patterns)) as (spans, own):
            status = run_spans(MONITOR, specifications, spans, report, patterns, own=own, margins=margins)
        if status:
            raise typer.Exit(status)
    except SpecificationError as error:
        raise refusal(error.findings) from None


def _specifications(appliance: Appliance, what: str, folders: Sequence[Path]) -> Specifications:
    path = Path(what)
    if path.suffix == ".rv" or path.is_file():
        return read_for_recordings(MONITOR, [path], folders)
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    names = [row.name for row in loaded.monitors]
    if what not in names:
        known = ", ".join(names) or "no monitor is loaded"
        raise MONITOR.usage_error(f"{what} is neither a file (.rv) nor a loaded monitor ({known})")
    given = {
        row.name: {one.name: one.value for one in row.given if one.kind != "topic"}
        for row in loaded.monitors
        if row.given
    }
    settings = loaded.topics or {}, given, loaded.on_fault, loaded.slices
    return Specifications(loaded.files or {}, loaded.definitions or {}, what, *settings)


def _topics(specifications: Specifications, patterns: Sequence[str]) -> dict[str, str]:
    return {
        topic: kind
        for topic, kind in topics_of(specifications).items()
        if any(fnmatchcase(topic, pattern) for pattern in patterns)
    }
