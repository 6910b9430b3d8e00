"""Report which parts of specifications recordings exercise."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

from rich.console import Console
from rich.table import Column

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.learn.exercised import CoverageItem, covered
from rosmop.run.engine import MonitorSet
from rosmop.tool.bag import RecordedBag, open_bag, refusals
from rosmop.tool.command_context import CommandContext
from rosmop.tool.specification_input import read_definitions, read_specifications
from rosmop.tool.tables import table_of
from rosmop.tool.terminal import refused, say, say_json

_KINDS = ("event", "branch", "function", "handler", "state", "transition")


def coverage(
    program: CommandContext,
    files: list[Path],
    folders: list[Path],
    bags: list[Path],
    *,
    fail_under: float,
    as_json: bool,
) -> int:
    """Report the exercised and the missing parts; return the exit status."""
    recordings = [RecordedBag(program, bag, ["*"]) for bag in bags]
    try:
        definitions = read_definitions(program, files, folders)
        for recording in recordings:
            definitions = recording.definitions.extended(definitions)
        texts = read_specifications(program, files)
        monitors = MonitorSet.of(compiled_from(texts, definitions))
        for bag in bags:
            with closing(open_bag(program, bag)) as reader:
                for text in refusals(monitors, reader):
                    raise program.usage_error(f"{bag}: {text}")
        counts = covered(texts, definitions, recordings)
    except SpecificationError as error:
        raise refused(error.findings) from None
    exercised = sum(count > 0 for count in counts.values())
    percent = 100 * exercised / len(counts) if counts else 100.0
    if as_json:
        for item, count in counts.items():
            say_json({
                "specification": item.specification, "kind": item.kind, "what": item.what,
                "file": item.position.file, "line": item.position.line, "count": count,
            })  # fmt: skip
    else:
        _show(counts)
        say(f"{exercised} of {len(counts)} exercised: {percent:.1f} %")
    return 1 if percent < fail_under else 0


def _show(counts: dict[CoverageItem, int]) -> None:
    columns = (Column(kind, justify="right") for kind in _KINDS)
    table = table_of("monitor", *columns)
    for name in dict.fromkeys(item.specification for item in counts):
        own = [(item, count) for item, count in counts.items() if item.specification == name]
        table.add_row(
            name, *(_fraction(count for item, count in own if item.kind == kind) for kind in _KINDS)
        )
    Console(highlight=False).print(table)
    for item, count in counts.items():
        if not count:
            place = f"{item.position.file}:{item.position.line}"
            say(f"{place}: never: {item.kind} {item.what} of {item.specification}", "yellow")


def _fraction(counts: Iterable[int]) -> str:
    found = list(counts)
    return f"{sum(count > 0 for count in found)}/{len(found)}" if found else "-"
