"""Find the door of a signed-in caller: the door with the token's name, or with the name of a person's group.

An administrator chooses these names. A name that the provider gives a person opens no door, because people can
choose it at some providers.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from appliance.control.operators.sessions import Session
from appliance.features.doors.door_rows import DoorRow
from appliance.features.doors.door_table import DoorTable, is_door_name


class CallerDoor(NamedTuple):
    """The door of a caller; without a `row`, `reason` has the cause and the remedy."""

    name: str
    row: DoorRow | None
    reason: str


class OwnDoors:
    """The doors of all callers; `people()` returns the sessions of people."""

    def __init__(self, table: DoorTable, people: Callable[[], Iterable[Session]]) -> None:
        self._table = table
        self._people = people

    def of(self, who: str) -> CallerDoor:
        groups = self._groups(who)
        names = [name for name in ([who] if groups is None else groups) if is_door_name(name)]
        live = {row.name: row for row in self._table.live()}
        found = next((name for name in names if name in live), None)
        if found is not None:
            return CallerDoor(found, live[found], "")
        if names:
            return CallerDoor(names[0], None, f"you have no door: rosrv door add {names[0]}")
        if groups is None:
            text = f"no door can have the name {who[:80]}: use a token with the name of a door (a-z, 0-9, _ and -)"
        else:
            text = f"no group of {who[:140]} has the name of a door: name one in sso.doors of appliance.yaml"
        return CallerDoor("", None, text)

    def _groups(self, who: str) -> list[str] | None:
        people = [person for person in self._people() if person.name == who]
        return [group for person in people for group in person.groups] if people else None
