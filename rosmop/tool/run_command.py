"""Run monitors on a recording."""

from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

from rosmop.fast.build import fast_path_of
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.tool.bag import OutputBag, definitions_of, open_bag, refusals, replay
from rosmop.tool.bounded_bag import BoundedReader
from rosmop.tool.command_context import CommandContext
from rosmop.tool.monitor_output import lines, record
from rosmop.tool.progress_bar import progress
from rosmop.tool.specification_input import load
from rosmop.tool.terminal import counted, refused, say, say_json

_PROGRESS_EVERY = 1000


def run(
    program: CommandContext,
    files: list[Path],
    folders: list[Path],
    bag: Path,
    *,
    output: Path | None,
    as_json: bool,
) -> None:
    """Report the outcome of every message, by the recording's clock."""
    with closing(open_bag(program, bag)) as reader:
        try:
            compiled = load(program, files, folders, definitions_of(reader))
        except SpecificationError as error:
            raise refused(error.findings) from None
        fast = fast_path_of(compiled) if find_spec("wasmtime") is not None else None
        monitors = MonitorSet.of(compiled, fast=fast)
        for text in refusals(monitors, reader):
            program.warn(f"{text}; its messages are dropped")
        if output is None:
            _report(monitors, reader, None, as_json=as_json)
        else:
            with OutputBag(program, output, monitors.definitions) as recording:
                _report(monitors, reader, recording, as_json=as_json)


def _report(
    monitors: MonitorSet, reader: BoundedReader, recording: OutputBag | None, *, as_json: bool
) -> None:
    counts = {"passed": 0, "changed": 0, "dropped": 0}
    verdicts = faults = 0
    with progress("replaying", lambda: reader.message_count, shares_screen=True) as advance:
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
            if not number % _PROGRESS_EVERY:
                advance(sum(counts.values()))
    if not as_json:
        total = ", ".join(f"{number} {word}" for word, number in counts.items())
        say(f"{counted(sum(counts.values()), 'message')}: {total}; "
            f"{counted(verdicts, 'verdict')}, {counted(faults, 'fault')}")  # fmt: skip
