"""Replace a running set by a set of other texts, as loading specifications does."""

from collections.abc import Mapping

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from roswire.definitions import Definitions


def replaced(
    before: MonitorSet, sources: Mapping[str, str], definitions: Definitions, time_ns: int
) -> tuple[MonitorSet, Outcome]:
    following = MonitorSet.of(compiled_from(sources, definitions), before.on_fault, before.patience)
    return following, following.succeed(before, time_ns)
