"""Parse and compile the texts of specifications."""

from collections.abc import Mapping

from rosmop.check.specification import compile_files, findings_of
from rosmop.form.compiled import Compiled
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.text import tree
from rosmop.text.parser import parse
from roswire.definitions import Definitions


def compiled_from(sources: Mapping[str, str], definitions: Definitions, *, margins: bool = False) -> Compiled:
    """Compile files (name to text) in this order; raises `SpecificationError` with all errors."""
    files: list[tree.SpecificationFile] = []
    findings: list[Diagnostic] = []
    for name, text in sources.items():
        try:
            files.append(parse(text, name))
        except SpecificationError as error:
            findings += error.findings
    if findings:
        raise SpecificationError([*findings, *findings_of(files, definitions)])
    return compile_files(files, definitions, margins=margins)
