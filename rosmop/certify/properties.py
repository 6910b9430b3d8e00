"""Certify the compiled properties of specifications."""

from collections.abc import Iterable

from rosmop.certify.check import AutomatonTables, Certificate, certify
from rosmop.form.compiled import SpecificationCode
from rosmop.form.findings import Diagnostic
from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.tfsm import TimedStateMachine

DEFECT = "this is a defect of the monitor compiler, and nothing is loaded; report it with the specification"


def certificate_of(compiled: CompiledProperty) -> Certificate:
    tables = None
    if isinstance(compiled, FiniteProperty | TimedStateMachine):
        automaton = compiled.automaton
        timeouts = compiled.timeouts if isinstance(compiled, TimedStateMachine) else ()
        tables = AutomatonTables(automaton.initial, automaton.table, automaton.verdicts, timeouts)
    return certify(compiled.logic, compiled.formula, compiled.events, tables)


def certificates_of(
    specifications: Iterable[SpecificationCode],
) -> tuple[dict[str, list[str]], list[Diagnostic]]:
    lines: dict[str, list[str]] = {}
    wrong: list[Diagnostic] = []
    for specification in specifications:
        mine = lines.setdefault(specification.name, [])
        for declared in specification.properties:
            compiled = declared.property
            certificate = certificate_of(compiled)
            mine.append(f"{compiled.logic}: {certificate.text}")
            if certificate.wrong:
                text = (
                    f"the automaton of this property differs from its formula: {certificate.text}; {DEFECT}"
                )
                wrong.append(compiled.source.finding(0, text))
    return lines, wrong
