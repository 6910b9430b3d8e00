"""`rosrv monitor check|run`: judge specifications, and try them on a recording; no appliance needs to run.

Exit status: 0 right (warnings or not), whatever the verdicts; 1 a specification with errors; 2 usage.
"""

from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.monitor.bag import Recording, definitions_of, open_bag, refusals, replay
from appliance.cli.monitor.bounded_bag import BoundedReader
from appliance.cli.monitor.input import Files, Folders, read_definitions, read_specifications, usage_error
from appliance.cli.monitor.monitor_output import explained, lines, record, say_finding
from appliance.cli.output import Json, counted, printable, refused, say, say_json
from appliance.cli.progress_bar import progress
from rosmop.certify.properties import certificates_of
from rosmop.check.sources import compiled_from
from rosmop.form.positions import Finding
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.picture import dot_of, svg_of
from rosmop.run.engine import MonitorSet
from rosmop.text.errors import SpecificationError
from roswire.definitions import Definitions

_TOLD_EVERY = 1000


def check(
    files: Files,
    *,
    as_json: Json = False,
    msg: Folders = None,
    prove: Annotated[
        bool,
        typer.Option(
            "--prove", help="Also prove that the relay's code of each event does what the event means"
        ),
    ] = False,
    dot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata for Graphviz")] = None,
    svg: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata as a picture")] = None,
) -> None:
    """Report every error and warning with its place; exit status 1 if there is an error.

    `--prove` needs the package z3-solver, takes up to a few seconds for each event, and says of each what is proved;
    exit status 1 if code of one does something else.

    Example: rosrv monitor check monitors/*.rv
    """
    if prove and find_spec("z3") is None:
        raise usage_error("--prove needs the package z3-solver: pip install 'rosrv-appliance[prove]'")
    try:
        monitors = _load(files, msg or [])
        certificates, wrong = certificates_of(monitors.monitors)
        findings = [*wrong, *monitors.warnings]
    except SpecificationError as error:
        monitors, certificates = None, {}
        findings = list(error.findings)
    for finding in findings:
        say_finding(finding, as_json=as_json)
    errors = sum(finding.severity == "error" for finding in findings)
    if not as_json:
        _summarise(findings, errors, monitors)
        for monitor in monitors.monitors if monitors is not None else ():
            for line in explained(monitor):
                say(f"{monitor.name}: {line}")
            for line, running in zip(certificates[monitor.name], monitor.properties, strict=True):
                say(f"{monitor.name}: {line}")
                say(f"{monitor.name}: {running.code.property.logic}: {running.code.enforcement}")
    if monitors is not None:
        properties = [
            running.code.property for monitor in monitors.monitors for running in monitor.properties
        ]
        _draw(properties, dot, svg)
        if prove:
            from appliance.cli.monitor.proof import say_proofs  # noqa: PLC0415  its package may be missing

            errors += say_proofs(monitors, as_json=as_json)
    raise typer.Exit(1 if errors else 0)


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
            monitors = _load(files, msg or [], definitions_of(reader))
        except SpecificationError as error:
            raise refused(error.findings) from None
        monitors.write_module()
        for text in refusals(monitors, reader):
            typer.echo(f"rosrv monitor: {printable(text)}; its messages are dropped", err=True)
        if output is None:
            _report(monitors, reader, None, as_json=as_json)
        else:
            with Recording(output, monitors.definitions) as recording:
                _report(monitors, reader, recording, as_json=as_json)


def _load(files: list[Path], folders: list[Path], recorded: Definitions | None = None) -> MonitorSet:
    definitions = read_definitions(files, folders)
    if recorded is not None:
        definitions = recorded.extended(definitions)
    return MonitorSet.of(compiled_from(read_specifications(files), definitions))


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


def _summarise(findings: list[Finding], errors: int, monitors: MonitorSet | None) -> None:
    warnings = len(findings) - errors
    tail = f", {counted(warnings, 'warning')}" if warnings else ""
    if monitors is None:
        say(f"{counted(errors, 'error')}: refused{tail}", "red")
        return
    number = len(monitors.monitors)
    say(f"{counted(number, 'specification')} right{tail}", "green")


def _draw(properties: list[CompiledProperty], dot: Path | None, svg: Path | None) -> None:
    for path, draw in ((dot, dot_of), (svg, svg_of)):
        if path is None:
            continue
        picture = draw(properties)
        if picture is None:
            text = "no property's monitor is a finite automaton: there is nothing to draw"
            typer.echo(f"rosrv monitor: {text}, and {path} is not written", err=True)
            continue
        try:
            path.write_text(picture, encoding="utf-8")
        except OSError as error:
            raise usage_error(f"cannot write {path}: {error.strerror}") from error
