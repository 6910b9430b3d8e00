"""Warn of what specifications of a set do to one another, and of their actions."""

from collections.abc import Iterator, Sequence

from rosmop.check.flow_lint import flow_findings
from rosmop.check.phases import Phases
from rosmop.check.publication_order import bypassing
from rosmop.check.scope import CompilationContext
from rosmop.check.traps import rival_changes
from rosmop.form.compiled import SpecificationCode
from rosmop.form.findings import Diagnostic
from rosmop.text import tree


def lint_set(
    shared: CompilationContext,
    compiled: Sequence[SpecificationCode],
    specifications: Sequence[tree.Specification],
    phases: Phases,
) -> Iterator[Diagnostic]:
    if shared.lints and not any(finding.severity == "error" for finding in shared.findings):
        yield from flow_findings(shared, compiled)
    yield from bypassing(compiled, shared.publications, shared.functions)
    yield from rival_changes(specifications, phases)
