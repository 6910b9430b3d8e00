from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from rosmop.run.fast_path import BatchOptions, NativeCall

SUBSCRIBERS: Final[int]
SMALL: Final[int]
LARGE: Final[int]
BASE: Final[int]
CELLS: Final[int]
HAS_CELLS: Final[int]
UNARMED: Final = 0
RECEIVED: Final = 1
JUDGED: Final = 2
SENT: Final = 3
LITTLE: Final[float]

def walk(frames: memoryview, messages: int = ..., size: int = ...) -> tuple[int, int, int]: ...

class CellsPlace(Protocol):
    @property
    def memory(self) -> memoryview: ...
    @property
    def flags(self) -> int: ...
    @property
    def cells(self) -> tuple[int, int]: ...

class _Topic(Protocol):
    @property
    def plain(self) -> Version: ...
    @property
    def counters(self) -> Traffic: ...
    @property
    def keeps_large(self) -> bool: ...

class Left(NamedTuple):
    kind: int
    end: int = 0
    size: int = 0
    messages: int = 0
    since: float = 0.0
    judged: int = 0
    answer: int | Exception | None = None
    number: int = 0
    sent: int = 0

class Version:
    @property
    def number(self) -> int: ...
    def change(self) -> None: ...

class Traffic:
    @property
    def messages(self) -> int: ...
    @property
    def size(self) -> int: ...
    @property
    def following(self) -> int: ...
    def add(self, messages: int, size: int) -> None: ...
    def delayed(self, seconds: float, messages: int) -> None: ...
    def take(self) -> tuple[int, int, list[int], float]: ...

class ModuleCall:
    def __init__(
        self,
        preparation: Version,
        native: NativeCall,
        options: BatchOptions,
        place: CellsPlace,
        *,
        offset: int,
        until: int,
    ) -> None: ...
    @property
    def valid(self) -> bool: ...
    def settle(self) -> None: ...

class PumpedConnection:
    def arm(
        self,
        descriptor: int,
        topic: _Topic,
        subscribers: Sequence[int],
        module: ModuleCall | None,
        torn: bytes,
    ) -> None: ...
    def disarm(self) -> bytes: ...
    def step(self) -> Left | None: ...

class Pump:
    def __init__(self, epoll: int) -> None: ...
    @property
    def began(self) -> float: ...
    def receive_into(self, area: memoryview) -> None: ...
    def connection(self) -> PumpedConnection: ...
    def crowd(self, descriptor: int) -> None: ...
    def put(self, descriptor: int, entry: PumpedConnection | None) -> None: ...
    def wait(self, longest: float, most: int, steps: bool) -> list[tuple[int, int]]: ...
