"""Define the work on the machine that a feature does in the supervisor, ordered by control.

Control is not trusted: each piece of work checks its terms. It runs in a thread, one piece at a time.
"""

from collections.abc import Mapping
from typing import Protocol, TypeAlias

from appliance.network.isolation import Isolation

Terms: TypeAlias = Mapping[str, object]
Found: TypeAlias = dict[str, object]


class MachineWork(Protocol):
    def takes_over(self) -> bool:
        """Return whether the robot's own ROS master may run beside the appliance, which takes over its graph."""

    def holds(self) -> bool:
        """Return whether nodes must reach the appliance only, even while it starts again after a crash."""

    def wants(self) -> bool:
        """Return whether the graph of the robot's own master is to be taken over, or not yet given back."""

    def left_alone(self) -> tuple[str, ...]:
        """Return the control groups of the robot's own masters."""

    def nodes(self) -> tuple[str, ...]:
        """Return keys of processes that were connected to the robot's own master (`process_key`)."""

    def end(self) -> None:
        """Note that the appliance ends by an order, not because of a failure."""

    def carry_out(self, robot_side: Isolation, work: str, terms: Terms) -> Found:
        """Carry out a piece of work, and return what was found. Raises `NetworkError`, `ValueError`."""


class NoMachineWork:
    """The work of an appliance without such a feature."""

    def takes_over(self) -> bool:
        return False

    def holds(self) -> bool:
        return False

    def wants(self) -> bool:
        return False

    def left_alone(self) -> tuple[str, ...]:
        return ()

    def nodes(self) -> tuple[str, ...]:
        return ()

    def end(self) -> None:
        pass

    def carry_out(self, _robot_side: Isolation, work: str, _terms: Terms) -> Found:
        raise ValueError(f"no feature does {work[:40]!r} on the machine")
