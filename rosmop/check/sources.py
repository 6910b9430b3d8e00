"""Parse and compile the texts of specifications."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType

from rosmop.check.acted_topics import written_topics
from rosmop.check.givens import Topics, with_topics
from rosmop.check.observed_topics import with_observed_topics
from rosmop.check.specification import compile_files, findings_of
from rosmop.form.compiled import Compiled
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.text import tree
from rosmop.text.parser import parse
from roswire.definitions import Definitions


def compiled_from(
    sources: Mapping[str, str],
    definitions: Definitions,
    *,
    margins: bool = False,
    lints: bool = True,
    without_code: Collection[str] = (),
    topics: Topics = MappingProxyType({}),
) -> Compiled:
    """Compile files (name to text) in this order. Raises `SpecificationError` with all errors.

    The specifications of files in `without_code` keep only their names, topics and services, and do nothing; they
    act on the topics on which their text may act. Without `lints`, there are no warnings.
    """
    files: list[tree.SpecificationFile] = []
    written: dict[str, tuple[str, ...]] = {}
    findings: list[Diagnostic] = []
    for name, text in sources.items():
        try:
            parsed = parse(text, name)
            if name in without_code:
                written |= {
                    one.name: written_topics(with_topics(one, topics.get(one.name, {})))
                    for one in parsed.specifications
                }
                parsed = _without_code(parsed)
            files.append(parsed)
        except SpecificationError as error:
            findings += error.findings
    if findings:
        raise SpecificationError([*findings, *findings_of(files, definitions)])
    compiled = with_observed_topics(
        compile_files(files, definitions, margins=margins, lints=lints, topics=topics)
    )
    if not written:
        return compiled
    codes = tuple(replace(one, acts_on=written.get(one.name, one.acts_on)) for one in compiled.specifications)
    return replace(compiled, specifications=codes)


def _without_code(file: tree.SpecificationFile) -> tree.SpecificationFile:
    return replace(file, specifications=tuple(map(_idle, file.specifications)))


def _idle(specification: tree.Specification) -> tree.Specification:
    events = tuple(
        replace(event, action=replace(event.action, statements=())) for event in specification.events
    )
    observing = tuple(
        replace(event, modifiers=(), parameters=(), trigger=replace(event.trigger, pattern=(), when=None))
        for event in events
        if isinstance(event.trigger, tree.MessageTrigger)
    )
    return replace(
        specification,
        parameters=(),
        declarations=(),
        functions=(),
        inits=(),
        events=observing or events,
        properties=(),
        withholds=(),
    )
