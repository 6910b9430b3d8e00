"""Texts of specifications, read and compiled."""

from collections.abc import Mapping

from appliance.ros.definitions import Definitions
from appliance.rosmop.compile.specification import compile_files, findings_of
from appliance.rosmop.compiled import Compiled
from appliance.rosmop.positions import Finding
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.syntax.parser import parse


def compiled_from(sources: Mapping[str, str], definitions: Definitions, *, margins: bool = False) -> Compiled:
    """Compile files (name to text) in this order; raises `SpecificationError` with all that is wrong."""
    files: list[tree.File] = []
    findings: list[Finding] = []
    for name, text in sources.items():
        try:
            files.append(parse(text, name))
        except SpecificationError as error:
            findings += error.findings
    if findings:
        raise SpecificationError([*findings, *findings_of(files, definitions)])
    return compile_files(files, definitions, margins=margins)
