"""Parse and compile the texts of specifications."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType

import msgspec

from rosmop.check.acted_topics import acted_topics, published_topics, written_topics
from rosmop.check.givens import Topics, with_topics
from rosmop.check.locate import FieldLocator, MessageCursor
from rosmop.check.specification import compile_files, findings_of
from rosmop.form import nodes
from rosmop.form.compiled import Compiled, EventCode
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.form.sites import Site, Symbols
from rosmop.run.guards import guards_of
from rosmop.text import tree
from rosmop.text.parser import parse
from roswire.definitions import Definitions

# Note on which topics each specification acts, and let events on the others read whole messages only.
#
# An event reads only the fields of its pattern, so it would take a message that is cut off behind them, or too long, as
# evidence. On a topic on which the specification acts this needs no check: subscribers reject what they cannot read.


class _EndSymbols(Symbols):
    """Names that no other part of the compiler makes."""

    def fresh(self, prefix: str) -> str:
        return super().fresh(f"{prefix}end")


def with_observed_topics(compiled: Compiled) -> Compiled:
    """Return the compiled specifications with `acts_on`, and with a check of the length of observed messages.

    Only the events on which an action depends get this check.
    """
    functions, symbols = dict(compiled.functions), _EndSymbols()
    symbols.sites = [*compiled.sites]
    published = published_topics(functions.values())
    codes = tuple(
        replace(one, acts_on=acted_topics(one, functions, published.get(one.context, ())))
        for one in compiled.specifications
    )
    compiled = replace(compiled, specifications=codes)
    observing = guards_of(compiled).observing
    for code in codes:
        symbols.begin(code.name)
        for event in code.events:
            if event.function in observing:
                name = event.key or event.function
                functions[name] = _check(functions[name], event, compiled, symbols)
    return replace(compiled, functions=functions, sites=symbols.sites)


def _check(
    function: nodes.Function, event: EventCode, compiled: Compiled, symbols: Symbols
) -> nodes.Function:
    statements: list[nodes.Statement] = []
    site = symbols.site(Site(event.position))
    layout = compiled.messages.definitions.layout(event.type or "")
    end = MessageCursor(FieldLocator(symbols, statements, site), layout, nodes.Spot(None, 0)).end()
    statements.append(nodes.Ends(site, end))
    happens = None if function.happens is None else function.happens + len(statements)
    return msgspec.structs.replace(function, body=(*statements, *function.body), happens=happens)


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
