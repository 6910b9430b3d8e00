"""`rosrv monitor check|run`: judge specifications, and try them on a recording; no appliance needs to run.

Exit status: 0 right (warnings or not), whatever the verdicts; 1 a specification with errors; 2 usage.
"""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.monitor.bag import Recording, definitions_of, open_bag, refusals, replay
from appliance.cli.monitor.bounded_bag import BoundedReader
from appliance.cli.monitor.monitor_program import MONITOR
from appliance.cli.output import Json
from appliance.cli.progress_bar import progress
from rosmop.fast.wasm_build import fast_path_of
from rosmop.run.engine import MonitorSet
from rosmop.text.errors import SpecificationError
from rosmop.tool import check_command
from rosmop.tool.monitor_output import lines, record
from rosmop.tool.options import Dot, Files, Folders, Prove, Svg
from rosmop.tool.specification_input import load
from rosmop.tool.terminal import counted, refused, say, say_json

_TOLD_EVERY = 1000


def check(
    files: Files,
    *,
    as_json: Json = False,
    msg: Folders = None,
    prove: Prove = False,
    dot: Dot = None,
    svg: Svg = None,
) -> None:
    """Report every error and warning with its place; exit status 1 if there is an error.

    `--prove` needs the package z3-solver, takes up to a few seconds for each event, and says of each what is proved;
    exit status 1 if code of one does something else.

    Example: rosrv monitor check monitors/*.rv
    """
    status = check_command.check(MONITOR, files, msg or [], as_json=as_json, prove=prove, dot=dot, svg=svg)
    raise typer.Exit(status)


def run(
    files: Files,
    *,
    bag: Annotated[Path, typer.Option(metavar="FILE", help="The recording", show_default=False)],
    as_json: Json = False,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write what subscribers would have received")
    ] = None,
    msg: Folders = None,
) -> None:
    """Give a recording to the monitors and report what came of every message, by the recording's clock.

    Example: rosrv monitor run monitors/safe_triggering.rv --bag drive.bag
    """
    with closing(open_bag(bag)) as reader:
        try:
            compiled = load(MONITOR, files, msg or [], definitions_of(reader))
        except SpecificationError as error:
            raise refused(error.findings) from None
        monitors = MonitorSet.of(compiled, fast=fast_path_of(compiled))
        for text in refusals(monitors, reader):
            MONITOR.warn(f"{text}; its messages are dropped")
        if output is None:
            _report(monitors, reader, None, as_json=as_json)
        else:
            with Recording(output, monitors.definitions) as recording:
                _report(monitors, reader, recording, as_json=as_json)


def _report(
    monitors: MonitorSet, reader: BoundedReader, recording: Recording | None, *, as_json: bool
) -> None:
    counts = {"passed": 0, "changed": 0, "dropped": 0}
    verdicts = faults = 0
    with progress("replaying", lambda: reader.message_count, shares_screen=True) as told:
        for number, replayed in enumerate(replay(monitors, reader, recording)):
            outcome = replayed.outcome
            if replayed.topic is not None:
                counts[outcome.result] += 1
            verdicts += len(outcome.verdicts)
            faults += len(outcome.faults)
            if as_json:
                say_json(record(outcome, replayed.index, replayed.topic))
            else:
                for line in lines(outcome, replayed.index, replayed.topic):
                    say(line)
            if not number % _TOLD_EVERY:
                told(sum(counts.values()))
    if not as_json:
        total = ", ".join(f"{number} {word}" for word, number in counts.items())
        say(f"{counted(sum(counts.values()), 'message')}: {total}; "
            f"{counted(verdicts, 'verdict')}, {counted(faults, 'fault')}")  # fmt: skip
