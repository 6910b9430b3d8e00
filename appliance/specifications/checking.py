"""Compile whole sets of specifications; control has the process `compiler` for this."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from types import MappingProxyType

import msgspec

from appliance.channel.answers.monitor_answers import GivenState
from appliance.channel.messages import Contents, PartNames, StateOwner
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
    checked,
    require_bounded,
)
from rosmop.check.sources import compiled_from
from rosmop.fast.build import certify, parts_of, require_loadable
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions

Topics = Mapping[str, Mapping[str, str]]
"""Given topics by monitor and name."""

NO_TOPICS: Topics = MappingProxyType({})

_ERROR = ": error: "  # a finding of this severity; the others are warnings
_LONGEST = 32 << 20  # bytes: half of what a channel carries
_START_INSTRUCTIONS = (
    500_000  # some 0.1 s, in which a relay carries no message: ten times what a message always has
)


def contents(
    files: Mapping[str, str],
    texts: Mapping[str, str],
    *,
    load: bool = False,
    at_start: bool = False,
    unbuilt: Mapping[str, str] = {},
    given_topics: Topics = NO_TOPICS,
    lints: bool = True,
) -> Contents:
    """Compile specifications. Raises `SpecificationsRefusedError` with all errors.

    `load`: also build and load the module. `at_start`: they may have been in force, so `init` has no limit. The
    monitors of the files in `unbuilt` do nothing. Without `lints`, only errors are found.
    """
    try:
        definitions = _standard().merge(Definitions.from_files(texts))
        monitors = MonitorSet.of(
            compiled_from(files, definitions, lints=lints, without_code=unbuilt, topics=given_topics)
        )
        certificates, data = certify(monitors.compiled)
        if load:
            require_loadable(data)
        if not at_start:
            _require_short_start(monitors)
    except SpecificationError as error:
        raise SpecificationsRefusedError([str(finding) for finding in error.findings]) from error
    except DefinitionError as error:
        raise SpecificationsRefusedError([f"msg/{error}"]) from error
    except (MemoryError, SystemError):  # of the whole process, not of these files
        raise
    except Exception as error:  # a defect of the compiler is a reason to refuse, no more
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
        raise SpecificationsRefusedError([text]) from error
    topics, services = (
        {
            monitor.name: frozenset(
                event.topic
                for event in monitor.code.events
                if event.topic is not None and (event.part is None) is messages
            )
            for monitor in monitors.monitors
        }
        for messages in (True, False)
    )
    called = {call.specification: set[str]() for call in monitors.compiled.calls}
    for call in monitors.compiled.calls:
        called[call.specification].add(call.topic)
    services = {name: own | called.get(name, set()) for name, own in services.items()}
    types = dict(monitors.topics) | dict(monitors.publications)
    return Contents(
        {monitor.name: monitor.code.file for monitor in monitors.monitors},
        topics,
        services,
        dict(monitors.publications),
        tuple(str(warning) for warning in monitors.warnings),
        types,
        {name: definitions.full_text(name) for name in types.values()},
        tuple(map(frozenset, monitors.compiled.groups(monitors.names))),
        {monitor.code.file: monitors.published_by(monitor.code.file) for monitor in monitors.monitors},
        certificates,
        _bounded(data),
        _places(monitors),
        {one.name: unbuilt[one.code.file] for one in monitors.monitors if one.code.file in unbuilt},
        {
            monitor.name: StateOwner(
                monitors.identity(monitor.code).hex(),
                frozenset(monitor.held_channels) if monitors.holds_if_lost(monitor.code) else frozenset(),
                str(monitor.code.position),
            )
            for monitor in monitors.monitors
        },
        givens={name: states for name in monitors.names if (states := tuple(_givens(monitors, name)))},
        switches={monitor.name: monitor.code.switch for monitor in monitors.monitors if monitor.code.switch},
    )


def _require_short_start(monitors: MonitorSet) -> None:
    monitors.start(0)
    spent = {name: context.most - context.budget for name, context in monitors.interpreter.contexts.items()}
    if sum(spent.values()) > _START_INSTRUCTIONS:
        longest = max(monitors.monitors, key=lambda monitor: spent[monitor.code.context])
        text = (
            f"the first values and `init` of all specifications take more than {_START_INSTRUCTIONS} instructions,"
            f" in which no message passes; most are those of {longest.name}: do less there"
        )
        raise SpecificationError.at(longest.code.position, text)


def _givens(monitors: MonitorSet, name: str) -> Iterator[GivenState]:
    code = monitors.monitor(name).code
    for given in code.givens:
        kind = "bool" if given.bounds is None else "int" if isinstance(given.default, int) else "double"
        yield GivenState(
            given.name, kind, given.default, given.unit, given.default, *(given.bounds or (None, None))
        )
    for topic in code.given_topics:
        yield GivenState(topic.name, "topic", topic.topic, "", topic.default)


def contents_at_start(
    files: Mapping[str, str],
    texts: Mapping[str, str],
    given_topics: Topics = NO_TOPICS,
    *,
    lints: bool = True,
) -> Contents:
    """Compile for a start: files with errors do nothing. Raises `SpecificationsRefusedError` beyond a limit."""
    try:
        return contents(files, texts, load=True, at_start=True, given_topics=given_topics, lints=lints)
    except SpecificationsRefusedError as error:
        refusal = error
    good, errors = _good(files, texts, given_topics)
    bad = {file: errors[file] for file in files if file not in good}
    left_out = {file: error for file, error in bad.items() if not _topics_known(files[file], file, texts)}
    rest = {file: text for file, text in files.items() if file not in left_out}
    unbuilt = {file: error for file, error in bad.items() if file in rest}
    try:
        definitions = texts if rest else {}
        found = contents(
            rest,
            definitions,
            load=True,
            at_start=True,
            unbuilt=unbuilt,
            given_topics=given_topics,
            lints=lints,
        )
    except SpecificationsRefusedError:
        raise refusal from None
    return msgspec.structs.replace(found, left_out=left_out)


def contents_beside(
    files: Mapping[str, str],
    texts: Mapping[str, str],
    broken: Collection[str],
    given_topics: Topics = NO_TOPICS,
) -> Contents:
    """Compile for a change; only the files in `broken`, which had errors before, may still have them."""
    found = contents_at_start(files, texts, given_topics)
    errors = found.left_out | {found.monitors[name]: error for name, error in found.unbuilt.items()}
    fresh = [error for file, error in errors.items() if file not in broken]
    if fresh:
        raise SpecificationsRefusedError(fresh)
    return found


def check(
    sources: Sources, site_keys: Sequence[str], *, compiler: Callable[..., Contents] = contents
) -> CheckedSpecifications:
    """Compile in the caller's process; with `site_keys`, each text must be signed."""
    if not sources.files:
        return CheckedSpecifications()
    require_bounded(sources)
    return checked(
        compiler(sources.files, sources.definitions, given_topics=sources.topics), sources, site_keys
    )


def _topics_known(text: str, file: str, texts: Mapping[str, str]) -> bool:
    try:
        contents({file: text}, texts, at_start=True, unbuilt={file: ""}, lints=False)
    except SpecificationsRefusedError:
        return False
    return True


def _good(
    files: Mapping[str, str], texts: Mapping[str, str], topics: Topics
) -> tuple[set[str], dict[str, str]]:
    errors: dict[str, str] = {}

    def grown(good: set[str], more: Sequence[str]) -> set[str]:
        try:
            wanted = {file: files[file] for file in files if file in {*good, *more}}
            contents(wanted, texts, load=True, at_start=True, given_topics=topics, lints=False)
        except SpecificationsRefusedError as error:
            if len(more) == 1:
                errors[more[0]] = next((one for one in error.findings if _ERROR in one), error.findings[0])
                return good
            half = len(more) // 2
            return grown(grown(good, more[:half]), more[half:])
        return good | {*more}

    good, before = set[str](), None
    while good != before:  # a file may need the variables of one that came after it
        good, before = grown(good, [file for file in files if file not in good]), good
    return good, errors


def _places(monitors: MonitorSet) -> dict[str, str]:
    named = [
        (event.position, event.topic) for monitor in monitors.monitors for event in monitor.code.events
    ] + [(publication.position, publication.topic) for publication in monitors.compiled.publications]
    places: dict[str, str] = {}
    for position, topic in sorted(named, key=lambda one: one[0]):
        if topic is not None:
            places.setdefault(topic, str(position))
    return places


def parts(compiled: bytes, wanted: Sequence[PartNames]) -> list[bytes]:
    """Return the parts of compiled specifications. Raises `SpecificationsRefusedError`."""
    try:
        return [*map(_bounded, parts_of(compiled, [(names.monitors, names.shadows) for names in wanted]))]
    except SpecificationError as error:
        raise SpecificationsRefusedError([str(finding) for finding in error.findings]) from error


def _bounded(data: bytes) -> bytes:
    if len(data) > _LONGEST:
        text = f"the compiled specifications take {len(data) >> 20} MiB; the limit is {_LONGEST >> 20} MiB: load fewer"
        raise SpecificationsRefusedError([text])
    return data


@cache
def _standard() -> Definitions:
    return standard_definitions()
