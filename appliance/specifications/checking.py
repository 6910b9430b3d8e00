"""Compile whole sets of specifications; for control, this runs in the process `compiler`."""

from collections.abc import Mapping, Sequence
from functools import cache

from appliance.channel.messages import Contents, PartNames
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
    checked,
    require_bounded,
)
from rosmop.check.sources import compiled_from
from rosmop.fast.build import ModuleDefectError, certified, parts_of
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions

_LONGEST = 32 << 20  # bytes: half of what a channel carries


def check(sources: Sources, site_keys: Sequence[str]) -> CheckedSpecifications:
    """Compile everything in the caller's process. Raises `SpecificationsRefusedError` with all errors.

    With `site_keys`, each text must be signed with one of these keys.
    """
    if not sources.files:
        return CheckedSpecifications()
    require_bounded(sources)
    return checked(contents(sources.files, sources.definitions), sources, site_keys)


def contents(files: Mapping[str, str], texts: Mapping[str, str]) -> Contents:
    """Compile these files with these definitions. Raises `SpecificationsRefusedError` with all errors."""
    try:
        definitions = _standard().extended(Definitions.from_files(texts))
        monitors = MonitorSet.of(compiled_from(files, definitions))
        certificates, data = certified(monitors.compiled)
    except SpecificationError as error:
        raise SpecificationsRefusedError([str(finding) for finding in error.findings]) from error
    except DefinitionError as error:
        raise SpecificationsRefusedError([f"msg/{error}"]) from error
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
        {name: monitors.published_by(name) for name in files},
        certificates,
        _bounded(data),
        _places(monitors),
    )


def _places(monitors: MonitorSet) -> dict[str, str]:
    """Return the position where each topic is first named, as text."""
    named = [
        (event.position, event.topic) for monitor in monitors.monitors for event in monitor.code.events
    ] + [(publication.position, publication.topic) for publication in monitors.compiled.publications]
    places: dict[str, str] = {}
    for position, topic in sorted(named, key=lambda one: one[0]):
        if topic is not None:
            places.setdefault(topic, str(position))
    return places


def parts(compiled: bytes, wanted: Sequence[PartNames]) -> list[bytes]:
    """Return the parts of a set (`Contents.compiled`) for these relays. Raises `SpecificationsRefusedError`."""
    try:
        return [*map(_bounded, parts_of(compiled, [(names.monitors, names.shadows) for names in wanted]))]
    except ModuleDefectError as error:
        raise SpecificationsRefusedError([str(error)]) from error


def _bounded(data: bytes) -> bytes:
    if len(data) > _LONGEST:
        text = f"the compiled specifications take {len(data) >> 20} MiB; the limit is {_LONGEST >> 20} MiB: load fewer"
        raise SpecificationsRefusedError([text])
    return data


@cache
def _standard() -> Definitions:
    return standard_definitions()
