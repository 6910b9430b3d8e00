from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from appliance.relay.transport.frames import Scratch
from rosmop.run.fast_path import BatchOptions, NativeCall

SUBSCRIBERS: Final[int]
UNARMED: Final = 0
RECEIVED: Final = 1
JUDGED: Final = 2
SENT: Final = 3
CROWD: Final[str]
LITTLE: Final[float]

class CellsPlace(Protocol):
    @property
    def memory(self) -> memoryview: ...
    @property
    def flags(self) -> int: ...
    @property
    def cells(self) -> tuple[int, int]: ...

class _Interceptor(Protocol):
    preparation: object
    offset: int

class _Topic(Protocol):
    plain: object
    counters: Traffic

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
        interceptor: _Interceptor,
        native: NativeCall,
        options: BatchOptions,
        place: CellsPlace,
        *,
        until: int,
    ) -> None: ...

class PumpedConnection:
    @property
    def armed(self) -> bool: ...
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
    def connection(self, scratch: Scratch) -> PumpedConnection: ...
    def put(self, descriptor: int, entry: PumpedConnection | str | None) -> None: ...
    def wait(self, longest: float, most: int, steps: bool) -> list[tuple[int, int]]: ...
