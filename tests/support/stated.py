from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from appliance.channel.messages import PartNames, SpecificationsStated
from appliance.specifications.checking import parts
from rosmop.check.sources import compiled_from
from rosmop.fast.build import part_of
from rosmop.fast.serialization import encoded_part
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

NOTHING_LIKE_IT = b"\xc1"

_standard = cache(standard_definitions)


async def parts_here(compiled: bytes, wanted: list[PartNames]) -> list[bytes]:
    return parts(compiled, wanted)


def stated(
    revision: int,
    files: Sequence[tuple[str, str]],
    definitions: Mapping[str, str] = {},
    enabled: Mapping[str, bool] = {},
    restarted: bool = False,
    **more: Any,
) -> SpecificationsStated:
    if not files:
        return SpecificationsStated(revision, b"", {}, restarted, **more)
    known = _standard().merge(Definitions.from_files(definitions))
    try:
        monitors = MonitorSet.of(compiled_from(dict(files), known))
    except SpecificationError:
        return SpecificationsStated(revision, NOTHING_LIKE_IT, dict(enabled), restarted, **more)
    switches = {monitor.name: enabled.get(monitor.name, True) for monitor in monitors.monitors}
    part = part_of(monitors.compiled, list(switches), more.get("shadows", ()))
    return SpecificationsStated(revision, encoded_part(part), switches, restarted, **more)
