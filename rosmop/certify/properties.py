"""What is certified of the properties of specifications: the one place where the compilers' results come in."""

from collections.abc import Iterable

from rosmop.certify.check import Certificate, Tables, certify
from rosmop.form.positions import Finding
from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.tfsm import TimedMachine
from rosmop.run.monitor import Monitor

DEFECT = "this is a defect of the appliance: nothing is loaded with it; report it with the specification"


def certificate_of(compiled: CompiledProperty) -> Certificate:
    """Hold what was made of a formula against the formula."""
    tables = None
    if isinstance(compiled, FiniteProperty | TimedMachine):
        automaton = compiled.automaton
        timeouts = compiled.timeouts if isinstance(compiled, TimedMachine) else ()
        tables = Tables(automaton.initial, automaton.table, automaton.verdicts, timeouts)
    return certify(compiled.logic, compiled.formula, compiled.events, tables)


def certificates_of(monitors: Iterable[Monitor]) -> tuple[dict[str, list[str]], list[Finding]]:
    """For each monitor a line on each of its properties; and an error for each property whose automaton is wrong."""
    lines: dict[str, list[str]] = {}
    wrong: list[Finding] = []
    for monitor in monitors:
        mine = lines.setdefault(monitor.name, [])
        for running in monitor.properties:
            compiled = running.code.property
            certificate = certificate_of(compiled)
            mine.append(f"{compiled.logic}: {certificate.text}")
            if certificate.wrong:
                text = f"the automaton of this property is not what is written: {certificate.text}; {DEFECT}"
                wrong.append(compiled.source.finding(0, text))
    return lines, wrong
