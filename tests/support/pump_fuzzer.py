"""Mistreat the relay's pump, compiled with AddressSanitizer and UndefinedBehaviorSanitizer.

    .venv/bin/python -m tests.support.pump_fuzzer SEED BYTES    # builds it, and prints the number of each action

A seed determines the actions: mutated frames over real sockets, descriptors that close at any time, subscribers that
never read, a scratch area that is replaced and freed, a module that answers nonsense. The first memory error ends the
process.
"""

import contextlib
import ctypes
import gc
import importlib
import os
import select
import socket
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from random import Random
from types import SimpleNamespace
from typing import Any

import appliance.relay.transport
from distribution.extension import SANITIZED, build

_NAME = "tests.support.pump_fuzzer"
_FRAMES, _EFFECTS, _SURE, _CELLS, _OPTIONS = 8192, 256, 64, 96, 160  # places in the module's memory
_LARGE, _SMALL = 128 << 10, 4 << 10
_EDGES = (
    0,
    1,
    3,
    4,
    _SMALL - 5,
    _SMALL - 4,
    _SMALL,
    _LARGE - 4,
    _LARGE - 3,
    1 << 31,
    (1 << 32) - 4,
    (1 << 32) - 1,
)
_WILD = (-(1 << 63), -1, 0, 1, 16, 1 << 31, 1 << 32, (1 << 63) - 17, (1 << 63) - 1)
_EVENTS = (
    select.EPOLLIN, select.EPOLLIN | select.EPOLLOUT, select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLPRI,
    select.EPOLLIN | select.EPOLLET, select.EPOLLOUT, select.EPOLLIN | select.EPOLLONESHOT,
)  # fmt: skip
OUTCOMES = frozenset({"left: judged", "left: received", "left: sent", "left: unarmed", "module"})

_INVOKE = ctypes.CFUNCTYPE(
    ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int64), ctypes.c_size_t,
    ctypes.POINTER(ctypes.c_void_p),
)  # fmt: skip


class FuzzedConnection:
    def __init__(self, ours: socket.socket, theirs: socket.socket, pumped: Any, topic: Any) -> None:
        self.ours, self.theirs, self.pumped, self.topic = ours, theirs, pumped, topic
        self.owed = b""  # the rest of a frame that was torn


class PumpFuzzer:
    def __init__(self, pump: Any, seed: int) -> None:
        self._pump = pump
        self._random = Random(seed)  # noqa: S311  repeats a run
        self.done: Counter[str] = Counter()
        self.sent = 0
        self._epoll, self._crowd = select.epoll(), select.epoll()
        self._waiting = pump.Pump(self._epoll.fileno())
        self._epoll.register(self._crowd.fileno(), select.EPOLLIN)
        self._waiting.crowd(self._crowd.fileno())
        self._invoke = _INVOKE(self._answer)  # must live as long as its address
        self._module_memory = bytearray(1 << 18)
        self._use(memoryview(self._module_memory)[_FRAMES:])
        self._preparation = pump.Version()
        self._subscribers = [self._pair() for _ in range(17)]
        self._connections = [self._connect() for _ in range(3)]
        self._actions: list[tuple[int, Callable[[], None]]] = [
            (40, self._send), (40, self._wait), (12, self._arm), (6, self._read), (3, self._step), (2, self._replace),
            (2, self._end_publisher), (2, self._end_subscriber), (2, self._change), (1, self._move), (1, self._count),
            (1, self._misplace), (1, self._disarm), (1, self._misuse), (4, self._walk),
        ]  # fmt: skip
        self._weights = [weight for weight, _ in self._actions]

    def step(self) -> None:
        ((_, action),) = self._random.choices(self._actions, self._weights)
        name = action.__name__.strip("_")
        try:
            action()
            self.done[name] += 1
        except (
            OSError,
            ValueError,
            IndexError,
            TypeError,
            OverflowError,
            AttributeError,
            BufferError,
        ) as error:
            self.done[f"{name}: {type(error).__name__}"] += 1
            if self._random.random() < 0.3:  # a descriptor is closed
                self._replace()

    def close(self) -> None:
        self._epoll.close()
        self._crowd.close()
        for end in (end for pair in self._subscribers for end in pair):
            end.close()
        for connection in self._connections:
            connection.ours.close()
            connection.theirs.close()

    # --- the actions ---

    def _send(self) -> None:
        connection = self._random.choice(self._connections)
        data = connection.owed + b"".join(self._frame() for _ in range(self._random.choice((1, 1, 1, 2, 5))))
        if self._random.random() < 0.01:
            data += bytes(4 * self._random.choice((4096, 4097, 5000)))
        if self._random.random() < 0.2:
            data = self._mutated(data)
        cut = self._random.randrange(len(data) + 1) if self._random.random() < 0.3 else len(data)
        connection.owed = data[cut:][:_SMALL]
        sent = connection.theirs.send(data[:cut])
        self.sent += sent

    def _wait(self) -> None:
        longest = self._random.choice((0.0, 0.0, -1.0, 1e-4))
        found = self._waiting.wait(
            longest, self._random.choice((1, 2, 64, 64, 64, 64, 64, 64, 5000, 0)), self._random.random() < 0.9
        )
        for descriptor, _events in found:
            for connection in self._connections:
                if connection.ours.fileno() == descriptor and self._random.random() < 0.9:
                    self._take(connection)

    def _take(self, connection: FuzzedConnection) -> None:
        left = connection.pumped.step()
        if left is None:
            return
        self.done[f"left: {('unarmed', 'received', 'judged', 'sent')[left.kind]}"] += 1
        area, subscribers = self._area, self._pump.SUBSCRIBERS
        assert 0 <= left.size <= max(left.end, 0), left  # the area may have been replaced since
        assert 0 <= left.number < subscribers and left.sent < max(left.size, 1), left
        torn = connection.pumped.disarm()
        assert len(torn) <= _SMALL, left
        if left.kind == self._pump.UNARMED and self._random.random() < 0.9:
            with contextlib.suppress(BlockingIOError):
                connection.ours.recv(1 << 20)
        if left.kind == self._pump.RECEIVED:  # the next bytes begin a frame again
            connection.owed = b""
        if self._random.random() < 0.9:
            rest = b"" if left.kind == self._pump.RECEIVED else bytes(area[left.size : left.end])
            self._arm_one(connection, rest or torn)

    def _arm(self) -> None:
        torn = self._random.randbytes(self._random.choice((0, 0, 1, 3, 4, 9, _SMALL, _SMALL + 1)))
        self._arm_one(self._random.choice(self._connections), torn)

    def _arm_one(self, connection: FuzzedConnection, torn: bytes) -> None:
        number = self._random.choice((0, 1, 1, 1, 2, 2, 5, 16)) if self._random.random() < 0.98 else 17
        some = [pair[0].fileno() for pair in self._random.sample(self._subscribers, number)]
        if self._random.random() < 0.02:
            some[:1] = [self._random.choice((-1, 1 << 20, 1 << 31, connection.ours.fileno()))]
        module = self._module() if self._random.random() < 0.6 else None
        connection.pumped.arm(connection.ours.fileno(), connection.topic, some, module, torn)

    def _read(self) -> None:
        for _, theirs in self._random.sample(self._subscribers, 8):
            with contextlib.suppress(OSError):
                self.done["bytes at subscribers"] += len(theirs.recv(1 << 20))

    def _step(self) -> None:
        self._take(self._random.choice(self._connections))

    def _disarm(self) -> None:
        self._random.choice(self._connections).pumped.disarm()

    def _replace(self) -> None:
        number = self._random.randrange(len(self._connections))
        gone = self._connections[number]
        if self._random.random() < 0.8:
            gone.pumped.disarm()
        if self._random.random() < 0.8:
            self._waiting.put(gone.ours.fileno(), None)
        gone.ours.close()
        gone.theirs.close()
        self._connections[number] = self._connect()

    def _end_publisher(self) -> None:
        self._end(*self._random.choice([(one.ours, one.theirs) for one in self._connections]))

    def _end_subscriber(self) -> None:
        number = self._random.randrange(len(self._subscribers))
        self._end(*self._subscribers[number])
        if self._random.random() < 0.5:
            for end in self._subscribers[number]:
                end.close()
            self._subscribers[number] = self._pair()

    def _change(self) -> None:
        topic = self._random.choice(self._connections).topic
        if self._random.random() < 0.5:
            topic.plain.change()
        elif self._random.random() < 0.5:
            self._preparation.change()
        topic.keeps_large = self._random.random() < 0.5

    def _move(self) -> None:
        area: Any = memoryview(bytearray(self._random.choice((2 * _SMALL, 1 << 16, 512 << 10))))
        unfit = (
            bytearray(2 * _SMALL - 1),
            bytes(1 << 16),
            memoryview(bytearray(1 << 16))[::2],
            None,
            memoryview(b""),
        )
        if self._random.random() < 0.1:
            area = self._random.choice(unfit)
        elif self._random.random() < 0.8:
            self._module_memory = bytearray(self._random.choice((_FRAMES + 2 * _SMALL, 1 << 17, 1 << 20)))
            area = memoryview(self._module_memory)[_FRAMES:]
            self._preparation.change()
        self._use(area)
        gc.collect()

    def _count(self) -> None:
        counters = self._random.choice(self._connections).topic.counters
        counters.add(self._random.choice((0, 1, 1 << 62)), self._random.choice((0, 1 << 62)))
        counters.delayed(self._random.choice((0.0, -1.0, 1e9, 1e-7)), self._random.choice((0, 1, 1 << 40)))
        messages, _size, counts, _seconds = counters.take()
        assert isinstance(messages, int) and len(counts) in {0, 11}, counts

    def _walk(self) -> None:
        data = self._mutated(b"".join(self._frame() for _ in range(self._random.choice((0, 1, 5)))))
        bounds = (-(1 << 63), -1, 0, 1, len(data) - 1, len(data), (1 << 63) - 1)
        end, messages, last = self._pump.walk(data, *self._random.choices(bounds, k=2))
        assert 0 <= last <= end <= len(data) and 0 <= messages <= len(data), (end, messages, last)

    def _misplace(self) -> None:
        connection = self._random.choice(self._connections)
        descriptor = self._random.choice((-1, 0, 1, 70_000, connection.ours.fileno(), self._crowd.fileno()))
        entry: Any = self._random.choice((None, connection.pumped, object()))
        self._waiting.put(descriptor, entry)
        self._waiting.crowd(self._random.choice((-1, self._crowd.fileno(), descriptor)))

    def _misuse(self) -> None:
        pump, call = self._pump, self._module()
        one = self._random.choice((
            lambda: pump.PumpedConnection().step(),
            lambda: self._arm_bare(pump.PumpedConnection(), pump.Traffic(), pump.Version()),
            lambda: self._arm_bare(self._waiting.connection(), None, pump.Version()),
            lambda: self._arm_bare(self._waiting.connection(), object(), pump.Version()),
            lambda: self._arm_bare(self._waiting.connection(), pump.Traffic(), None),
            lambda: self._arm_bare(pump.Pump(-1).connection(), pump.Traffic(), pump.Version()),
            lambda: pump.Pump(-1).wait(0.0, 1, True),
            lambda: pump.Pump.__new__(pump.Pump).wait(0.0, 1, True),
            lambda: pump.Pump.__new__(pump.Pump).put(3, None),
            lambda: pump.ModuleCall.__new__(pump.ModuleCall).settle(),
            lambda: [call.__init__(*self._call(), offset=0, until=1) for _ in range(20)],
        ))  # fmt: skip
        one()

    def _arm_bare(self, pumped: Any, counters: Any, plain: Any) -> None:
        ours, theirs = self._pair()
        with ours, theirs:
            theirs.send(b"\0\0\0\0")
            module = self._random.choice((None, self._pump.ModuleCall.__new__(self._pump.ModuleCall)))
            topic = SimpleNamespace(plain=plain, counters=counters, keeps_large=True)
            pumped.arm(ours.fileno(), topic, [ours.fileno()], module, b"")
            pumped.step()

    # --- what they need ---

    def _connect(self) -> FuzzedConnection:
        ours, theirs = self._pair()
        topic = SimpleNamespace(plain=self._pump.Version(), counters=self._pump.Traffic(), keeps_large=True)
        connection = FuzzedConnection(ours, theirs, self._waiting.connection(), topic)
        where = self._random.choice((self._epoll, self._epoll, self._epoll, self._crowd))
        where.register(
            ours.fileno(), self._random.choice(_EVENTS) if self._random.random() < 0.2 else select.EPOLLIN
        )
        self._waiting.put(ours.fileno(), connection.pumped)
        return connection

    def _pair(self) -> tuple[socket.socket, socket.socket]:
        if self._random.random() < 0.7:
            pair = socket.socketpair()
        else:
            with socket.create_server(("127.0.0.1", 0)) as server:
                theirs = socket.create_connection(server.getsockname())
                pair = server.accept()[0], theirs
        for end in pair:
            end.setblocking(False)
            if self._random.random() < 0.2:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._random.choice((1, 5000, 1 << 20)))
        return pair

    def _end(self, ours: socket.socket, theirs: socket.socket) -> None:
        end = self._random.choice((ours, theirs, theirs))
        match self._random.randrange(4):
            case 0:
                end.close()
            case 1:
                end.shutdown(self._random.choice((socket.SHUT_RD, socket.SHUT_WR, socket.SHUT_RDWR)))
            case 2:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.close()
            case _:
                end.send(b"urgent", socket.MSG_OOB)

    def _frame(self) -> bytes:
        size = self._random.choice((0, 1, 4, 60, 60, 60, 300, 1000, _SMALL - 4, _SMALL))
        if self._random.random() < 0.003:
            size = self._random.choice((_LARGE - 4, _LARGE, 50_000))
        length = self._random.choice(_EDGES) if self._random.random() < 0.01 else size
        return struct.pack("<I", length) + self._random.randbytes(size)

    def _mutated(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self._random.choice((1, 1, 2, 10))):
            match self._random.randrange(3):
                case 0 if changed:
                    changed[self._random.randrange(len(changed))] = self._random.choice(
                        (0, 1, 4, 127, 128, 255)
                    )
                case 1:
                    at = self._random.randrange(len(changed) + 1)
                    changed[at : at + self._random.choice((0, 1, 4))] = self._random.randbytes(
                        self._random.choice((0, 1, 5))
                    )
                case _:
                    at = self._random.randrange(len(changed) + 1)
                    changed[at : at + 4] = struct.pack("<I", self._random.choice(_EDGES))
        return bytes(changed)

    def _use(self, area: Any) -> None:
        self._waiting.receive_into(area)
        self._area = area

    def _module(self) -> Any:
        offset, until = (
            self._random.choice((0, 1 << 60)),
            self._random.choice((1 << 62, 1 << 62, 1 << 63, 0, -5)),
        )
        return self._pump.ModuleCall(*self._call(), offset=offset, until=until)

    def _call(self) -> tuple[Any, Any, Any, Any]:
        memory = memoryview(self._module_memory)
        places = {
            "frames": _FRAMES,
            "effects": _EFFECTS,
            "sure": _SURE,
            "output": self._random.choice((0, _SURE)),
            "options": _OPTIONS,
        }
        cells = [(_CELLS, 8), (_CELLS + 8, 16)][: self._random.randrange(3)]
        cells *= self._random.choice((1, 1, 1, 1, 8, 9))
        kept, flags, homes = bytearray(256), self._random.choice((0, 0, 0, -1)), (16, 64)
        if self._random.random() < 0.1:
            places[self._random.choice(list(places))] = self._random.choice((*_WILD, len(memory) - 8))
        if self._random.random() < 0.1:
            cells.append(
                (self._random.choice((*_WILD, len(memory) - 8)), self._random.choice((*_WILD, 8, 64)))
            )
        if self._random.random() < 0.1:
            flags, homes = self._random.choice((*_WILD, 255, 256)), (self._random.choice((*_WILD, 240)), 250)
        packed = self._random.randbytes(
            32 if self._random.random() < 0.95 else self._random.choice((0, 31, 33, 1000))
        )

        def prepare(_options: Any) -> None:
            if self._random.random() < 0.9:
                memory[_OPTIONS : _OPTIONS + 32] = packed[:32]

        native = SimpleNamespace(
            invoke=ctypes.cast(self._invoke, ctypes.c_void_p).value, context=0, function=0, memory=memory, cells=cells,
            home=SimpleNamespace(prepare=prepare), packed=lambda _options: packed,
            failure=lambda error, trap: ValueError(f"{error} {trap}"), **places,
        )  # fmt: skip
        place = SimpleNamespace(memory=kept, flags=flags, cells=homes)
        options = SimpleNamespace(changed=self._random.choice(({}, {}, {}, {1: "one"}, None)))
        return self._preparation, native, options, place

    def _answer(self, _context: int, _function: int, slots: Any, _count: int, trap: Any) -> int:
        memory, end = self._module_memory, slots[2]
        self.done["module"] += 1
        if len(memory) > _FRAMES and self._random.random() < 0.5:
            memory[_SURE : _SURE + 4] = struct.pack(
                "<I", self._random.choice((0, _SURE, _SURE + 1, (1 << 32) - 1))
            )
            memory[_CELLS : _CELLS + 24] = self._random.randbytes(24)
        match self._random.randrange(16):
            case 0:
                return 0xDEAD
            case 1:
                trap[0] = 0xBEEF
            case 2:
                slots[0] = self._random.choice((*_WILD, end | 1 << 60, end - 1))
            case 3:
                slots[0] = self._random.getrandbits(64) - (1 << 63)
            case 4:
                effects = self._random.choice((1, 2, 20, 10_000, (1 << 28) - 1))
                slots[0] = end | effects << 32
                for number in range(min(effects, 20)):
                    at, pair = (
                        _EFFECTS + 16 * number,
                        (self._random.choice((-1, 0, 1, 3)), self._random.choice(_WILD)),
                    )
                    memory[at : at + 16] = struct.pack("<qq", *pair)
            case _:
                slots[0] = end
        return 0


def fuzz(seed: int, size: int) -> str:
    appliance.relay.transport.__path__.insert(0, str(build(SANITIZED).parent))
    pump = importlib.import_module("appliance.relay.transport.pump")
    assert SANITIZED in str(pump.__file__), pump.__file__
    fuzzer = PumpFuzzer(pump, seed)
    while fuzzer.sent < size or (fuzzer.sent < 10 * size and not fuzzer.done.keys() >= OUTCOMES):
        fuzzer.step()
    fuzzer.close()
    counts = "\n".join(f"{number:>9}  {name}" for name, number in sorted(fuzzer.done.items()))
    return f"seed {seed}: {fuzzer.sent} bytes\n{counts}\n"


def main(arguments: list[str]) -> None:
    if "LD_PRELOAD" not in os.environ:
        build(SANITIZED)
        library = subprocess.check_output(["gcc", "-print-file-name=libasan.so"], text=True).strip()
        os.environ |= {
            "LD_PRELOAD": library,
            "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:allocator_may_return_null=1",
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "PYTHONMALLOC": "malloc",  # each object has its own allocation, which AddressSanitizer watches
        }
        os.execv(sys.executable, [sys.executable, "-m", _NAME, *arguments])  # noqa: S606  this program again
    seed, size = arguments
    sys.stdout.write(fuzz(int(seed), int(float(size))))


if __name__ == "__main__":
    main(sys.argv[1:])
