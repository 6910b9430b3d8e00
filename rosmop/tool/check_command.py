"""Check specifications."""

from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

from rosmop.fast.build import certify, require_loadable
from rosmop.fast.slow_paths import slow_paths
from rosmop.form.compiled import Compiled
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.picture import dot_of, svg_of
from rosmop.run.engine import MonitorSet
from rosmop.tool.command_context import CommandContext
from rosmop.tool.monitor_output import explain, say_finding
from rosmop.tool.specification_input import load
from rosmop.tool.terminal import say, say_json
from roswire.counted import counted


def check(
    program: CommandContext,
    files: list[Path],
    folders: list[Path],
    *,
    as_json: bool,
    prove: bool,
    why_slow: bool,
    dot: Path | None,
    svg: Path | None,
) -> int:
    for package, module in (("z3-solver", "z3"), ("wasmtime", "wasmtime")):
        if prove and find_spec(module) is None:
            raise program.usage_error(f"--prove needs the package {package}: pip install {package}")
    try:
        monitors = MonitorSet.of(load(program, files, folders))
        certificates, data = certify(monitors.compiled)
        if find_spec("wasmtime") is not None:
            require_loadable(data)
        findings = [*monitors.warnings]
    except SpecificationError as error:
        monitors, certificates = None, {}
        findings = list(error.findings)
    for finding in findings:
        say_finding(finding, as_json=as_json)
    errors = sum(finding.severity == "error" for finding in findings)
    if not as_json:
        _summarise(findings, errors, monitors)
        for monitor in monitors.monitors if monitors is not None else ():
            for line in explain(monitor):
                say(f"{monitor.name}: {line}")
            for line, running in zip(certificates[monitor.name], monitor.properties, strict=True):
                say(f"{monitor.name}: {line}")
                say(f"{monitor.name}: {running.code.property.logic}: {running.code.enforcement}")
    if monitors is not None:
        properties = [
            running.code.property for monitor in monitors.monitors for running in monitor.properties
        ]
        _draw(program, properties, dot, svg)
        if why_slow:
            _say_slow(monitors.compiled, as_json=as_json)
        if prove:
            from rosmop.tool.proof_output import say_proofs  # noqa: PLC0415  its package may be missing

            errors += say_proofs(monitors, as_json=as_json)
    return 1 if errors else 0


def _say_slow(compiled: Compiled, *, as_json: bool) -> None:
    paths = slow_paths(compiled)
    for path in paths:
        if as_json:
            say_json(
                {"topic": path.topic, "code": path.code, **asdict(path.position), "why_slow": path.reason}
            )
        elif path.code:
            say(f"{path.position}: {path.topic}: {path.code}: interpreted here, because it {path.reason}")
        else:
            say(f"{path.position}: {path.topic}: each message is interpreted, because it {path.reason}")
    if not paths and not as_json:
        here = (
            ""
            if find_spec("wasmtime") is not None
            else "; here all are interpreted: wasmtime is not installed"
        )
        say(f"compiled code processes every message{here}")


def _summarise(findings: list[Diagnostic], errors: int, monitors: MonitorSet | None) -> None:
    warnings = len(findings) - errors
    tail = f", {counted(warnings, 'warning')}" if warnings else ""
    if monitors is None:
        say(f"{counted(errors, 'error')}: rejected{tail}", "red")
        return
    number = len(monitors.monitors)
    say(f"{counted(number, 'specification')} OK{tail}", "green")


def _draw(
    program: CommandContext, properties: list[CompiledProperty], dot: Path | None, svg: Path | None
) -> None:
    for path, draw in ((dot, dot_of), (svg, svg_of)):
        if path is None:
            continue
        picture = draw(properties)
        if picture is None:
            program.warn(f"{path} is not written: no property has a finite automaton to draw")
            continue
        try:
            program.write(path, picture.encode())
        except OSError as error:
            raise program.usage_error(f"cannot write {path}: {error.strerror}") from error
