"""List the features and tools. The core imports only this module, `feature.py` and the views of the folder `features`.

To remove a feature, remove its folder and its name here, and its view in `views.py`.
"""

import importlib
import importlib.util
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature, Tool

if TYPE_CHECKING:
    from appliance.supervisor.machine_work import MachineWork
    from appliance.supervisor.service_gate import Pairing

NAMES = (
    "audit_tools",
    "policy_tools",
    "monitor_tools",
    "alarms",
    "limits",
    "blocks",
    "sign",
    "topics",
    "tunnels",
    "syslog",
    "evidence",
    "recorder",
    "standby",
    "fleet",
    "doors",
    "guards",
    "backup",
    "tokens",
    "selftest",
    "demo",
    "survey",
    "logbook",
    "adopt",
    "sso",
    "authority",
    "approvals",
    "metrics",
    "live",
)


def _folder(name: str) -> Tool:
    folder: Tool = importlib.import_module(f"{__package__}.{name}.feature").FEATURE
    return folder


FOLDERS = {name: _folder(name) for name in NAMES}
TOOLS = tuple(FOLDERS.values())
"""All of them: a feature is also a tool."""
FEATURES = tuple(folder for folder in TOOLS if isinstance(folder, Feature))


def member(folder: str, file: str, name: str) -> Any:
    """Return what one of a folder's files defines under a name, or None without the file or the name."""
    module = f"{__package__}.{folder}.{file}"
    if importlib.util.find_spec(module) is None:
        return None
    return getattr(importlib.import_module(module), name, None)


def members(file: str, name: str) -> list[Any]:
    """Return what the files of this name define under a name, in the order of the table."""
    return [found for folder in NAMES if (found := member(folder, file, name)) is not None]


def recorded_messages() -> Any:
    """Return the function that gives `rosrv monitor replay` the messages of a period; None without a recorder."""
    return next(iter(members("replay_input", "recorded_messages")), None)


def verb_function(group: str, name: str) -> Any:
    """Return the function of a feature's verb, for another feature; None without that feature."""
    groups = (tool.verbs[group] for tool in TOOLS if group in tool.verbs)
    verbs = (verbs.verbs[name] for verbs in groups if isinstance(verbs, Group) and name in verbs.verbs)
    return next((pkgutil.resolve_name(verb.path) for verb in verbs if isinstance(verb, Verb)), None)


def pairing_in(state: Path) -> "Pairing | None":
    """Return what the start of one of two appliances needs, or None on a single one. Raises `StartError`."""
    pairings: list[Callable[[Path], Pairing | None]] = members("pairing", "pairing_in")
    return next(filter(None, (pairing(state) for pairing in pairings)), None)


def machine_work_in(state: Path) -> "MachineWork | None":
    """Return the feature's work in the supervisor, which may change the machine; None if there is none."""
    return next((machine(state) for machine in members("machine_side", "machine")), None)


def start_gate() -> Any:
    """Return the feature's `StartGate`; None: nothing decides when control may serve."""
    return next((gate() for gate in members("gate", "GATE")), None)
