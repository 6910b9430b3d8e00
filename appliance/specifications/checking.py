"""Specifications compiled as a whole, for `files.check`."""

from collections.abc import Sequence
from functools import cache

from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.standard import standard_definitions
from appliance.rosmop.certify.properties import certificates_of
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.specifications.files import Checked, Sources, SpecificationsRefusedError


def checked(sources: Sources, site_keys: Sequence[str]) -> Checked:
    """What they are. Raises `SpecificationsRefusedError` with all that is wrong."""
    try:
        definitions = _standard().extended(Definitions.from_files(sources.definitions))
        monitors = MonitorSet.load(sources.files, definitions)
    except SpecificationError as error:
        raise SpecificationsRefusedError([str(finding) for finding in error.findings]) from error
    except DefinitionError as error:
        raise SpecificationsRefusedError([f"msg/{error}"]) from error
    certificates, wrong = certificates_of(monitors.monitors)
    if wrong:
        raise SpecificationsRefusedError([str(finding) for finding in wrong])
    return Checked(
        {monitor.name: monitor.code.file for monitor in monitors.monitors},
        {
            monitor.name: frozenset(
                e.topic for e in monitor.code.events if e.topic is not None and e.part is None
            )
            for monitor in monitors.monitors
        },
        {
            monitor.name: frozenset(
                e.topic for e in monitor.code.events if e.topic is not None and e.part is not None
            )
            for monitor in monitors.monitors
        },
        dict(monitors.publications),
        tuple(str(warning) for warning in monitors.warnings),
        dict(monitors.topics) | dict(monitors.publications),
        definitions,
        {monitor.name: monitor.code.uses for monitor in monitors.monitors},
        {name: monitors.published_by(name) for name in sources.files},
        sources.signers(site_keys),
        certificates,
    )


@cache
def _standard() -> Definitions:
    return standard_definitions()
