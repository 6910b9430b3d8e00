"""Name the files of an adoption in the state directory, and keep those that a release needs."""

from pathlib import Path

from appliance.features.adopt.adopt_record import Phase, load_record
from appliance.network.namespaces import NetworkError

STATE_FILES = ("adopt.json",)
"""The files that may exist before the first start."""


def obstacle_to_purge(state: Path) -> str | None:
    """Return why the directory must not be erased now; None if nothing is left to give back."""
    try:
        if load_record(state).phase is Phase.FREE:
            return None
    except NetworkError as error:
        return str(error)
    return (
        f"the robot's graph is adopted, and {state} is needed to give it back: stop the appliance, then rosrv release"
        f" --dead --state {state}"
    )
