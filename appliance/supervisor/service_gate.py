"""Decide whether the appliance may serve; a feature can decide for one of two appliances."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class RoleChanges:
    """The changes of the role. `suspend()` keeps all state until `resume()`; it returns False if it cannot."""

    activate: Callable[[int], None]
    passivate: Callable[[], None]
    suspend: Callable[[], bool]
    resume: Callable[[], None]


class ServiceGate:
    """The gate of a single appliance, which may always serve, in epoch 0.

    `accepts` has the messages of roles by which the gate decides. While control is stopped, operators get `paused` or
    `ended_text` as the answer.
    """

    accepts: Mapping[str, tuple[type, ...]] = {}
    member = False
    suspended = False
    paused = ended_text = ""

    def __init__(self, changes: RoleChanges) -> None:
        self._changes = changes
        self.epoch: int | None = 0

    @property
    def active(self) -> bool:
        return self.epoch is not None and not self.suspended

    def heard(self, message: object) -> None: ...

    def died(self, role: str, *, serves_robot: bool) -> None: ...


@dataclass(frozen=True)
class Pairing:
    """One of two appliances, before it starts.

    `robot` is an address of the robot. Only `other` may send to `port`. `files` have names, users and contents.
    `fixed_authority` is why the authority of hosts cannot be replaced. `rosrv up` prints one of the `waiting` fields
    while control waits for its role, and `ready` is the status for systemd then.
    """

    robot: str
    other: str
    port: int
    files: tuple[tuple[str, str, bytes], ...]
    nice: int
    gate: Callable[[RoleChanges], ServiceGate]
    fixed_authority: str
    waiting_event: Mapping[str, str]
    waiting_text: str
    ready: str
