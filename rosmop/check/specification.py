"""Compile a set of files with specifications, which see each other's variables. One pass finds all errors."""

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from hashlib import sha256
from types import MappingProxyType
from typing import TypeVar

from rosmop.check.enforcement import blocking_refused, enforcement, remedy_code, with_remedy
from rosmop.check.event_facts import declare_facts
from rosmop.check.event_functions import compile_event
from rosmop.check.expressions import value_of
from rosmop.check.flow_lint import flow_findings
from rosmop.check.function_bodies import (
    compile_function,
    compile_handler,
    compile_library,
    compile_start,
    declare_functions,
    declare_variables,
)
from rosmop.check.givens import (
    Topics,
    declare_givens,
    given_topics,
    read_at_start,
    with_given,
    with_topics,
)
from rosmop.check.pattern_references import with_references, without_references
from rosmop.check.remedies import with_remedies_checked
from rosmop.check.safe_messages import declare_safes
from rosmop.check.scope import CompilationContext, SpecificationNames
from rosmop.check.slicing import check_parameters, declare_parameters, slicing_of, unsliceable
from rosmop.check.specification_lint import (
    kept_slices,
    lint_property,
    lint_size,
    lint_statements,
    unused_events,
)
from rosmop.check.traps import Phases, evaluation_order, phases_of, rival_changes, traps, unknown_phases
from rosmop.check.withholdings import withholdings
from rosmop.form import nodes
from rosmop.form.compiled import Compiled, PropertyCode, Publication, SpecificationCode
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.logics.catalogue import compile_property
from rosmop.logics.interface import CompiledProperty, FormulaError
from rosmop.text import tree
from rosmop.types.messages import MessageTypes, nearest, quote
from roswire.definitions import Definitions

# Find the message types that a specification uses. Its state survives new definitions only if they are unchanged.
#
# The result may include an unused type, if a string equals the name of a type.


def reached_types(node: tree.Specification, definitions: Definitions) -> frozenset[str]:
    messages, services = set(definitions.message_types), set(definitions.service_types)
    waiting: list[str] = []
    for name in set(_names(node)):
        if name in messages:
            waiting.append(name)
        if name in services:
            service = definitions.service(name)
            waiting += [service.request.name, service.response.name]
    types: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in messages and name not in types:
            types.add(name)
            waiting += [field.type for field in definitions.message(name).fields]
    return frozenset(types)


def identity(node: tree.Specification) -> bytes:
    return sha256(repr(_plain(node)).encode()).digest()


def _plain(node: object) -> object:
    if isinstance(node, tuple):
        return tuple(map(_plain, node))
    if is_dataclass(node):
        named = ((field, getattr(node, field.name)) for field in fields(node) if field.compare)
        # A part that a file does not use leaves its digest as it was before the language had this part.
        parts = (_plain(value) for field, value in named if field.default != () or value != ())
        return (type(node).__name__, *parts)
    return node


def _names(root: object) -> Iterator[str]:
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if isinstance(node, str):
            yield node.replace("::", "/")
        elif isinstance(node, tuple | list):
            if len(node) == 2 and all(isinstance(part, str) for part in node):
                yield "/".join(node)
            waiting += node
        elif isinstance(node, tree.SyntaxNode):
            waiting += tree.fields_of(node)


# Warn of what specifications of a set do to one another, and of their actions.

# Warn of monitors that act on a topic, but do not see messages that another monitor publishes there.
#
# A published message only goes through the monitors after its publisher in the order of all specifications.


def bypassing(
    specifications: Sequence[SpecificationCode],
    publications: Sequence[Publication],
    functions: Mapping[str, nodes.Function],
) -> Iterator[Diagnostic]:
    places = {specification.name: place for place, specification in enumerate(specifications)}
    seen: set[tuple[str, str, str]] = set()
    for publication in publications:
        if publication.safe:
            continue
        for earlier in specifications[: places.get(publication.specification, 0)]:
            pair = publication.specification, earlier.name, publication.topic
            if pair in seen or not _acts_on(earlier, publication.topic, functions):
                continue
            seen.add(pair)
            name, topic = publication.specification, publication.topic
            text = (
                f"{name} publishes {topic}, but {earlier.name}, which drops or changes messages there, comes before"
                f" {name} and does not see them: write `order {name} < {earlier.name};`"
            )
            yield Diagnostic(publication.position, "warning", text)


def _acts_on(code: SpecificationCode, topic: str, functions: Mapping[str, nodes.Function]) -> bool:
    events = [event.function for event in code.events if event.topic == topic and event.part is None]
    handlers = [name for each in code.properties for name in each.handlers.values()] if events else []
    return any(
        isinstance(node, nodes.Drop | nodes.StopMessage)
        or (isinstance(node, nodes.WriteBack) and node.writes)
        for name in (*events, *handlers)
        for node in nodes.walk(functions[name])
    )


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


_T = TypeVar("_T")

_TAKEN = "revisions"
MODIFIERS = frozenset({"hold", "begin"})
IGNORED_MODIFIERS = frozenset({"unsynchronized", "decentralized", "perthread", "suffix", "creation"})
"""Modifiers of MOP that control how a monitor is generated. They have no effect here."""


def compile_files(
    files: Sequence[tree.SpecificationFile],
    definitions: Definitions,
    *,
    margins: bool = False,
    lints: bool = True,
    topics: Topics = MappingProxyType({}),
) -> Compiled:
    """Compile parsed files. Raises `SpecificationError` with all errors.

    With `margins`, comparisons of numbers are noted (`expressions.py`). Without `lints`, there are no warnings, and
    what only finds warnings in files without errors is left out. `topics` replace the topics in the files.
    """
    shared = CompilationContext(MessageTypes(definitions), value_of, margins=margins, lints=lints)
    pairs = [(file, specification) for file in files for specification in file.specifications]
    orders = [order for file in files for order in file.orders]
    compiled: Sequence[SpecificationCode] = ()
    phases = _note_findings(shared, partial(phases_of, orders, [specification for _, specification in pairs]))
    if phases is not None:
        names = [specification.name for _, specification in pairs]
        shared.findings += unknown_phases(orders, names)
        pairs = [pairs[place] for place in evaluation_order(names, phases)]
        named = frozenset(name.parts[0] for order in orders for name in order.names)
        compiled = _compile_all(shared, pairs, topics, phases, named)
    findings = list(dict.fromkeys(shared.findings))
    if any(finding.severity == "error" for finding in findings):
        raise SpecificationError(findings)
    return Compiled(
        tuple(compiled),
        tuple(sorted(findings, key=lambda finding: finding.position)) if lints else (),
        shared.functions,
        shared.symbols.sites,
        shared.variables.types,
        shared.messages,
        tuple(shared.publications),
        tuple(shared.calls),
    )


def findings_of(files: Sequence[tree.SpecificationFile], definitions: Definitions) -> list[Diagnostic]:
    """Return the errors of these files if other files of the set, which may declare unknown names, are unreadable."""
    shared = CompilationContext(MessageTypes(definitions), value_of)
    shared.partial = True
    pairs = [(file, specification) for file in files for specification in file.specifications]
    _compile_all(shared, pairs, {}, frozenset(), frozenset())
    return list(dict.fromkeys(shared.findings))


def _compile_all(
    shared: CompilationContext,
    originals: Sequence[tuple[tree.SpecificationFile, tree.Specification]],
    topics: Topics,
    phases: Phases,
    named: Collection[str],
) -> list[SpecificationCode]:
    given = [topics.get(specification.name, {}) for _, specification in originals]
    renamed = [(file, with_topics(one, own)) for (file, one), own in zip(originals, given, strict=True)]
    pairs = [(file, _rewrite(shared, specification)) for file, specification in renamed]
    names = [_declare(shared, specification) for _, specification in pairs]
    _check_names(shared, [specification for _, specification in pairs])
    compiled = []
    for (file, specification), own in zip(pairs, names, strict=True):
        code = _compile(shared, own, file, specification)
        if code is not None:
            compiled.append(code)
    written = {one.name: one for _, one in originals}
    for place, code in enumerate(compiled):
        original = written[code.name]
        replaced = given_topics(shared, original, topics.get(code.name, {}))
        whole = with_given(identity(original), replaced)
        compiled[place] = dataclasses.replace(
            code, identity=whole, given_topics=replaced, ordered=code.name in named
        )
    _check_types(shared, compiled)
    if not any(finding.severity == "error" for finding in shared.findings):
        compiled = with_remedies_checked(shared, compiled)
    shared.findings += [*lint_set(shared, compiled, [specification for _, specification in pairs], phases)]
    shared.findings += _same_names(shared.specifications)
    return compiled


def _rewrite(shared: CompilationContext, specification: tree.Specification) -> tree.Specification:
    rewritten = _note_findings(shared, partial(with_references, specification))
    return without_references(specification) if rewritten is None else rewritten


def _declare(shared: CompilationContext, specification: tree.Specification) -> SpecificationNames:
    shared.symbols.begin(specification.name)
    names = SpecificationNames(specification.name, shared.symbols.fresh("c"))
    shared.specifications.append(names)
    declare_parameters(shared, names, specification)
    declare_givens(shared, names, specification)
    declare_variables(shared, names, specification)
    declare_functions(shared, names, specification)
    declare_facts(shared, names, specification)
    size = sum(shared.values.width(variable.type) for variable in names.variables.values())
    shared.findings += lint_size(size, specification.position)
    return names


def _check_names(shared: CompilationContext, specifications: Sequence[tree.Specification]) -> None:
    seen: dict[str, tree.Specification] = {}
    for specification in specifications:
        if specification.name in seen:
            first = seen[specification.name].position
            text = (
                f"there is another specification {quote(specification.name)} at {first}; give it another name"
            )
            shared.findings.append(Diagnostic(specification.position, "error", text))
        seen[specification.name] = specification


def _same_names(specifications: Sequence[SpecificationNames]) -> Iterator[Diagnostic]:
    places = {names.name: place for place, names in enumerate(specifications)}
    pairs = {
        tuple(sorted((place, places[used])))
        for place, names in enumerate(specifications)
        for used in names.uses
        if used in places
    }
    for first, second in sorted(pairs):
        other, names = specifications[first], specifications[second]
        for name, variable in names.variables.items():
            if (
                name.isidentifier()
                and name in other.variables
                and not (variable.sliced or other.variables[name].sliced)
            ):
                text = f"{quote(name)} is also a variable of {other.name}; each has its own"
                yield Diagnostic(variable.position, "warning", text)


def _compile(
    shared: CompilationContext,
    names: SpecificationNames,
    file: tree.SpecificationFile,
    specification: tree.Specification,
) -> SpecificationCode | None:
    shared.symbols.begin(specification.name)
    _check_head(shared, specification)
    declare_safes(shared, names, specification)
    shared.findings += read_at_start(shared, names, specification)
    withheld = withholdings(shared, names, specification)
    start = _note_findings(shared, partial(compile_start, shared, names, specification))
    for function in names.functions.values():
        _note_findings(shared, partial(compile_function, shared, names, function))
    events = [
        _note_findings(shared, partial(compile_event, shared, names, specification, event))
        for event in specification.events
    ]
    check_parameters(shared, names, specification)
    good = tuple(event for event in events if event is not None)
    properties = [_property(shared, names, specification, node) for node in specification.properties]
    compile_library(shared, names)
    shared.findings += _seen_changes(names)
    if start is None or len(good) < len(events) or None in properties:
        return None
    known = tuple(code for code in properties if code is not None)
    shared.findings += unused_events(specification, known)
    shared.findings += lint_statements(specification)
    shared.findings += traps(specification)
    if names.parameters:
        shared.findings += kept_slices(names.name, good, known, specification.properties)
    given = {*names.givens, *_given_tables(specification)}
    variables = {one.name: one.code for one in names.variables.values() if one.name not in given}
    uses = frozenset(names.uses)
    return SpecificationCode(
        specification.name,
        specification.position,
        b"",  # the caller knows the topics as they are written
        reached_types(specification, shared.messages.definitions),
        file.name,
        any(modifier.parts == ("hold",) for modifier in specification.modifiers),
        start,
        names.context,
        good,
        known,
        variables,
        uses,
        tuple(sorted(names.comparisons.values(), key=lambda comparison: comparison.position)),
        slicing_of(shared, names, good, known),
        any(modifier.parts == ("begin",) for modifier in specification.modifiers),
        tuple(names.safes.values()),
        tuple(names.givens.values()),
        withholdings=withheld,
        switch=specification.switch,
    )


def _given_tables(specification: tree.Specification) -> Iterator[str]:
    """Yield the tables that operators set. Code has their items as literals, so a kept state does not have them."""
    for declaration in specification.declarations:
        for declarator in declaration.declarators:
            if isinstance(declarator.value, tree.GivenItems):
                yield declarator.name


def _seen_changes(names: SpecificationNames) -> Iterator[Diagnostic]:
    """Reject a constant reference to a variable that the called function changes: here it would keep the old value."""
    for loan in names.lent:
        if loan.variable.code in names.changed_by(loan.function):
            text = (
                f"`{loan.function}` gives `{loan.variable.name}` another value, which `{loan.parameter.name}` would"
                f" not show: leave out the `&` of `{loan.parameter.name}`, or use `{loan.variable.name}` itself"
            )
            yield Diagnostic(loan.position, "error", text)


def _note_findings(shared: CompilationContext, action: Callable[[], _T]) -> _T | None:
    try:
        return action()
    except SpecificationError as error:
        shared.findings += error.findings
        return None


def _check_head(shared: CompilationContext, specification: tree.Specification) -> None:
    for modifier in specification.modifiers:
        word = modifier.parts[0]
        if word in IGNORED_MODIFIERS:
            shared.findings.append(
                Diagnostic(modifier.position, "warning", f"{quote(word)} has no meaning here")
            )
        elif word not in MODIFIERS:
            text = f"{quote(word)} is not a modifier of a specification{nearest(word, MODIFIERS)}"
            shared.findings.append(Diagnostic(modifier.position, "error", text))
    if {modifier.parts[0] for modifier in specification.modifiers} >= MODIFIERS:
        text = "`hold` and `begin` exclude each other: leave one of them out"
        shared.findings.append(Diagnostic(specification.position, "error", text))
    if specification.name == _TAKEN:
        text = f"a specification cannot be named {quote(_TAKEN)}: the REST path /v1/monitors/{_TAKEN} is the history"
        shared.findings.append(Diagnostic(specification.position, "error", text))
    if not specification.events:
        text = f"the specification {quote(specification.name)} has no event; write `event name() /topic …`"
        shared.findings.append(Diagnostic(specification.position, "error", text))
    seen = set()
    for event in specification.events:
        if event.name in seen:
            shared.findings.append(
                Diagnostic(event.position, "error", f"the event {quote(event.name)} occurs twice")
            )
        seen.add(event.name)
        for modifier in event.modifiers:
            if specification.parameters and modifier.parts == ("creation",):
                continue
            text = f"the modifier {quote(modifier.parts[0])} of an event has no meaning here"
            shared.findings.append(Diagnostic(modifier.position, "warning", text))


# Properties


def _property(
    shared: CompilationContext,
    names: SpecificationNames,
    specification: tree.Specification,
    node: tree.Property,
) -> PropertyCode | None:
    events = tuple(dict.fromkeys(event.name for event in specification.events))
    try:
        compiled = compile_property(
            node.logic, node.formula, events, node.formula_position, node.position, dict(node.times)
        )
    except FormulaError as error:
        shared.findings += error.findings
        return None
    why = unsliceable(compiled) if specification.parameters else None
    if why is not None:
        shared.findings.append(Diagnostic(node.position, "error", why))
    handlers: dict[str, str] = {}
    remedy = _note_findings(shared, partial(remedy_code, shared, names, specification, compiled, node))
    if compiled.remedy is not None and remedy is None:
        return None
    for handler in with_remedy(compiled, node):
        text = _handler_refused(compiled, handlers, handler)
        if text is not None:
            shared.findings.append(Diagnostic(handler.position, "error", text))
            continue
        refused = blocking_refused(compiled, specification, handler.category)
        function = _note_findings(shared, partial(compile_handler, shared, names, handler, refused))
        if function is not None:
            handlers[handler.category] = function
    shared.findings += lint_property(compiled, node)
    made = {
        category: {type(part) for part in nodes.walk(shared.functions[name])}
        for category, name in handlers.items()
    }
    dropping = [category for category, parts in made.items() if parts & {nodes.Drop, nodes.StopMessage}]
    if compiled.suppresses:
        at = {handler.category: handler.position for handler in node.handlers}
        shared.findings += [
            Diagnostic(
                at[category],
                "warning",
                f"when @{category} drops the message, `__RESET;` does nothing: for `{compiled.logic}` a dropped message"
                " does not count; leave `__RESET;` out",
            )
            for category in dropping
            if nodes.Reset in made[category]
        ]
    said = (
        ""
        if remedy is not None
        else enforcement(
            compiled, specification, {category: shared.functions[name] for category, name in handlers.items()}
        )
    )
    return PropertyCode(compiled, handlers, tuple(handlers), said, remedy)


def _handler_refused(
    compiled: CompiledProperty, handlers: Mapping[str, str], handler: tree.Handler
) -> str | None:
    if handler.category in handlers:
        return f"@{handler.category} is handled twice; put both into one handler"
    if handler.category not in compiled.categories:
        known = nearest(handler.category, compiled.categories)
        return f"{compiled.logic} has no category {quote(handler.category)} here{known}"
    return None


def _check_types(shared: CompilationContext, compiled: Sequence[SpecificationCode]) -> None:
    types: dict[tuple[str, str | None], tuple[str, object]] = {}
    for specification in compiled:
        for event in specification.events:
            if event.topic is None or event.type is None:
                continue
            kind = event.service_type or event.type
            key = (event.topic, "service" if event.part else None)
            known, where = types.setdefault(key, (kind, event.position))
            if known != kind:
                text = f"{event.topic} has the type {known} at {where}, and {kind} here; a topic has one type"
                shared.findings.append(Diagnostic(event.position, "error", text))
    for called in shared.calls:
        known, where = types.setdefault((called.topic, "service"), (called.type, called.position))
        if known != called.type:
            text = f"{called.topic} has the type {known} at {where}, and {called.type} here"
            shared.findings.append(Diagnostic(called.position, "error", text))
    for published in shared.publications:
        known, where = types.setdefault((published.topic, None), (published.type, published.position))
        if known != published.type:
            text = f"{published.topic} has the type {known} at {where}, and {published.type} here"
            shared.findings.append(Diagnostic(published.position, "error", text))
