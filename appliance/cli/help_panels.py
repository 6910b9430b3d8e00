"""The panels of `rosrv --help`, in their order."""

from collections.abc import Iterable

PANELS: dict[str, tuple[str, ...]] = {
    "Begin": ("demo", "survey", "up", "adopt", "release", "status", "selftest", "version"),
    "Drive and stop": ("guard", "drive", "approve", "approval", "door"),
    "Decide who may do what": ("policy", "host", "protect", "sign"),
    "Watch the robot": ("topic", "node", "monitor", "record"),
    "Review": ("audit", "who-drove", "report", "evidence", "alarm", "limits"),
    "Let people and programs in": ("token", "sso", "certificate"),
    "Operate": ("config", "backup", "restore", "purge", "standby", "fleet"),
}
_FURTHER = "Further commands"


def panel_of(name: str) -> str:
    return next((panel for panel, names in PANELS.items() if name in names), _FURTHER)


def in_order(names: Iterable[str]) -> list[str]:
    """Return the names in the order of the panels; those without one are last, as they are."""
    known = [name for names_of in PANELS.values() for name in names_of]
    return sorted(names, key=lambda name: known.index(name) if name in known else len(known))
