"""Define everything that a feature can add to the core.

`docs/dev/architecture.md` lists the files of a feature. Each process loads `feature.py`, so it must be fast to import,
and those of the other files that it needs.

The core knows only this module and `table.py`. No feature imports another one. `feature.py` does not import
`configuration.settings`, because the settings import the table.
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from appliance.cli.verb_table import Verbs
from appliance.configuration.sections import FeatureSection
from appliance.quotas.table import QuotaRow
from appliance.supervisor.role import Role


class ConsolePart(NamedTuple):
    """A component of the console, in a file of the feature's folder `console`.

    A `view` is a page with this title. A `banner` is shown on every view, a `record` beside an audit record, a
    `situation` is a line on top of Now, and `standby` is the page of an appliance that is not active. A `search` is a
    function instead: it fetches what the search finds under this title. The parts of a place are sorted by `order`,
    then by the table of features. The files of `view`, `robot`, `record` and `search` are loaded when they are needed.
    """

    place: Literal["view", "banner", "situation", "now", "record", "robot", "search", "standby"]
    file: str
    component: str
    title: str = ""
    order: int = 0


@dataclass(frozen=True)
class Tool:
    """A folder with verbs and routes only: it has no data, no process and no part of control."""

    verbs: Verbs = field(default_factory=dict)


@dataclass(frozen=True)
class Feature(Tool):
    """A folder with data, a process or a part of control."""

    settings: type[FeatureSection] | None = None
    roles: tuple[Role, ...] = ()
    quotas: tuple[QuotaRow, ...] = ()
    console: tuple[ConsolePart, ...] = ()
