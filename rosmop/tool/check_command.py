"""Check specifications.

Exit status: 0 right (warnings or not), 1 a specification with errors, 2 usage.
"""

from importlib.util import find_spec
from pathlib import Path

from rosmop.certify.properties import certificates_of
from rosmop.form.positions import Finding
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.picture import dot_of, svg_of
from rosmop.run.engine import MonitorSet
from rosmop.text.errors import SpecificationError
from rosmop.tool.monitor_output import explained, say_finding
from rosmop.tool.program import Program
from rosmop.tool.specification_input import load
from rosmop.tool.terminal import counted, say


def check(
    program: Program,
    files: list[Path],
    folders: list[Path],
    *,
    as_json: bool,
    prove: bool,
    dot: Path | None,
    svg: Path | None,
) -> int:
    """Report every error and warning with its place; return the exit status."""
    if prove and find_spec("z3") is None:
        raise program.usage_error(
            f"--prove needs the package z3-solver: pip install '{program.package}[prove]'"
        )
    try:
        monitors = MonitorSet.of(load(program, files, folders))
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
        _draw(program, properties, dot, svg)
        if prove:
            from rosmop.tool.proof_output import say_proofs  # noqa: PLC0415  its package may be missing

            errors += say_proofs(monitors, as_json=as_json)
    return 1 if errors else 0


def _summarise(findings: list[Finding], errors: int, monitors: MonitorSet | None) -> None:
    warnings = len(findings) - errors
    tail = f", {counted(warnings, 'warning')}" if warnings else ""
    if monitors is None:
        say(f"{counted(errors, 'error')}: refused{tail}", "red")
        return
    number = len(monitors.monitors)
    say(f"{counted(number, 'specification')} right{tail}", "green")


def _draw(program: Program, properties: list[CompiledProperty], dot: Path | None, svg: Path | None) -> None:
    for path, draw in ((dot, dot_of), (svg, svg_of)):
        if path is None:
            continue
        picture = draw(properties)
        if picture is None:
            text = "no property's monitor is a finite automaton: there is nothing to draw"
            program.warn(f"{text}, and {path} is not written")
            continue
        try:
            path.write_text(picture, encoding="utf-8")
        except OSError as error:
            raise program.usage_error(f"cannot write {path}: {error.strerror}") from error
