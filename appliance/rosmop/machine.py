"""One WebAssembly module that runs: its memory to write into, its functions to call, bounds on both.

Theory of operation:

- Work is bounded by *fuel*, given with each call and used up by what the module does (about one for an instruction or
  a byte that is copied), the same on every machine. Memory is bounded by a limit. What goes beyond is a `MachineTrap`.
- The addresses of the whole limit are reserved at the start and the memory grows in place: a view of it is never
  wrong, an older one is only shorter. A view keeps the memory when the machine is closed.
- wasmtime's own call in Python costs 20 µs. Its C function is called directly (0.5 µs), under Python's lock, so that no
  other thread is ever within a machine. That stands on how this version lays out arguments: `calls_directly`
  tries it once, and where it is another, the slow call is taken, and the log says so.
- Traps come without signals: a handler of SIGSEGV (`faulthandler`) is not in the way.
"""

import ctypes
import struct
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import version
from typing import Any

import structlog
import wasmtime
from wasmtime import _ffi, _func

PAGE = 1 << 16
"""Memory grows by so many bytes."""

VERSION = "50."
"""How the versions of wasmtime begin whose layout of arguments is known."""

_FUEL_AT_START = 1_000_000
_TABLE_ELEMENTS = 10_000
_RESULTS: tuple[list[str], ...] = ([], ["i32"], ["i64"])
_OFF = ("threads", "shared_memory", "multi_memory", "memory64", "relaxed_simd", "simd", "tail_call", "gc",
        "function_references", "exceptions", "component_model", "custom_page_sizes",
        "stack_switching", "wide_arithmetic")  # fmt: skip
_log = structlog.get_logger()


class MachineError(Exception):
    """There is no such machine or function; the text says why."""


class MachineTrap(Exception):  # noqa: N818  its name in WebAssembly
    """A call was stopped; what it had written stays.

    `reason` says why ("integer division by zero"); `out_of_fuel`: its fuel was used up.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
        self.out_of_fuel = reason == "out of fuel"


class Machine:
    """A module and the memory that it exports as `memory`.

    `limit` is how large the memory may become, in bytes. `imports` are functions of integers that the module calls, by
    name: slow, not to call the machine in turn; what they raise goes through `call`. Raises `MachineError`, and
    `MachineTrap` for what the module does at its start.
    """

    def __init__(
        self, code: bytes, limit: int, imports: Mapping[str, Callable[..., int | None]] | None = None
    ) -> None:
        if not code.startswith(b"\0asm"):
            raise MachineError("not a WebAssembly module")
        engine = _engine(max(limit - 1, PAGE - 1).bit_length())
        store = wasmtime.Store(engine)
        store.set_limits(limit, _TABLE_ELEMENTS, instances=1, tables=1, memories=1)
        store.set_fuel(_FUEL_AT_START)
        try:
            module = wasmtime.Module(engine, code)
            given = []
            for needed in module.imports:
                function = (imports or {}).get(needed.name or "")
                if function is None or not isinstance(needed.type, wasmtime.FuncType):
                    raise MachineError(f"the module needs {needed.name}")
                given.append(wasmtime.Func(store, needed.type, function))
            exports = wasmtime.Instance(store, module, given).exports(store)
        except wasmtime.Trap as trap:
            raise _trapped(trap) from None
        except wasmtime.WasmtimeError as error:
            raise MachineError(str(error)) from None
        memory = exports.get("memory")
        if not isinstance(memory, wasmtime.Memory):
            raise MachineError("the module exports no memory")
        self._memory = memory
        self._store: wasmtime.Store | None = store
        self._functions = _functions(store, exports, _raw if calls_directly() else _public)
        self._view = memoryview(b"")

    @property
    def memory(self) -> memoryview:
        """All of the memory, to read and write; ask again when it has grown. Raises `MachineError` when closed."""
        store = self._open()
        if self._memory.data_len(store) != len(self._view):
            found = self._memory.get_buffer_ptr(store)
            found.keeps = store  # type: ignore[attr-defined]  # as long as there is a view
            self._view = memoryview(found).cast("B")
        return self._view

    def reserve(self, size: int) -> None:
        """Let the memory grow to `size` bytes or more. Raises `MachineError` beyond the limit."""
        store = self._open()
        missing = size - self._memory.data_len(store)
        try:
            self._memory.grow(store, max(-(-missing // PAGE), 0))
        except wasmtime.WasmtimeError:
            raise MachineError(f"{size} bytes are beyond the memory's limit") from None

    def call(self, name: str | int, *arguments: int, fuel: int) -> int | None:
        """The result of an exported function of integers (signed), by its name or its number among them.

        Each argument fits 64 bits with a sign; of one that the function takes in 32 bits these are given. Raises
        `MachineTrap`; `MachineError` where there is no such function or the machine is closed; `struct.error` where
        the arguments are not as many as it takes or too large.
        """
        try:
            function = self._functions[name]
        except KeyError:
            self._open()
            raise MachineError(f"the module has no function {name!r} of integers") from None
        return function(arguments, fuel)

    def close(self) -> None:
        """Give the module back, and the memory when the last view of it is gone."""
        self._functions, self._view, self._store = {}, memoryview(b""), None

    def _open(self) -> wasmtime.Store:
        if self._store is None:
            raise MachineError("the machine is closed")
        return self._store


_Call = Callable[[tuple[int, ...], int], int | None]


@cache
def _engine(bits: int) -> wasmtime.Engine:
    """What compiles the modules of all machines with a limit of up to 2**bits bytes."""
    config = wasmtime.Config()
    for feature in _OFF:
        setattr(config, feature if feature == "shared_memory" else f"wasm_{feature}", False)
    config.consume_fuel = True
    config.cranelift_nan_canonicalization = True  # a NaN in a message has the same bits on every machine
    config.memory_guard_size = 0
    config.memory_may_move = False
    config.memory_reservation = 1 << bits
    config.parallel_compilation = False  # no threads
    config.signals_based_traps = False
    return wasmtime.Engine(config)


def _functions(
    store: wasmtime.Store, exports: Mapping[str, object],
    bind: Callable[[wasmtime.Store, wasmtime.Func, int, list[str]], _Call],
) -> dict[str | int, _Call]:  # fmt: skip
    found: dict[str | int, _Call] = {}
    for name, export in exports.items():
        if isinstance(export, wasmtime.Func):
            kind = export.type(store)
            results = [str(one) for one in kind.results]
            if results in _RESULTS and {str(one) for one in kind.params} <= {"i32", "i64"}:
                found[len(found) // 2] = found[name] = bind(store, export, len(kind.params), results)
    return found


def _raw(store: wasmtime.Store, function: wasmtime.Func, arity: int, results: list[str]) -> _Call:
    """Calls through C: arguments and result stand in slots of 16 bytes; what comes back is ours to free."""
    library = ctypes.PyDLL(str(_ffi.filename))
    invoke, refuel = library.wasmtime_func_call_unchecked, library.wasmtime_context_set_fuel
    invoke.restype = refuel.restype = ctypes.c_void_p
    slots = (ctypes.c_uint64 * (2 * max(arity, 1)))()
    fill = struct.Struct("<" + "q8x" * arity).pack_into
    plain = memoryview(slots).cast("B")
    read = (plain.cast("i") if results == ["i32"] else plain.cast("q")) if results else (None,)
    native, trap, tank = function._func, ctypes.c_void_p(), ctypes.c_uint64()
    slots.keeps = store  # type: ignore[attr-defined]  # until the call is over, whoever closes the machine
    context = ctypes.cast(store._context(), ctypes.c_void_p)
    given = (context, ctypes.byref(native), slots, ctypes.c_size_t(len(slots) // 2), ctypes.byref(trap))

    def call(arguments: tuple[int, ...], fuel: int) -> int | None:
        fill(slots, 0, *arguments)
        tank.value = fuel
        refuel(context, tank)
        error = invoke(*given)
        if error is None and not trap:
            return read[0]
        if error is not None:
            stopped = MachineTrap(str(_owned(wasmtime.WasmtimeError, _ffi.wasmtime_error_t, error)))
        else:
            stopped = _trapped(_owned(wasmtime.Trap, _ffi.wasm_trap_t, trap.value))
            trap.value = None
        _func.maybe_raise_last_exn()  # of an imported function
        raise stopped

    return call


def _owned(kind: Any, structure: Any, address: int | None) -> Any:
    """The object that frees what stands there."""
    return kind._from_ptr(ctypes.cast(ctypes.c_void_p(address), ctypes.POINTER(structure)))


def _public(store: wasmtime.Store, function: wasmtime.Func, arity: int, results: list[str]) -> _Call:
    """Calls as wasmtime offers them."""
    del results
    check = struct.Struct(f"<{arity}q").pack

    def call(arguments: tuple[int, ...], fuel: int) -> int | None:
        check(*arguments)
        store.set_fuel(fuel)
        try:
            found: int | None = function(store, *arguments)
        except wasmtime.Trap as trap:
            raise _trapped(trap) from None
        except wasmtime.WasmtimeError as error:
            raise MachineTrap(str(error)) from None
        return found

    return call


def _trapped(trap: wasmtime.Trap) -> MachineTrap:
    code = trap.trap_code
    return MachineTrap(str(trap) if code is None else code.name.lower().replace("_", " "))


_TRIED = """(module
    (func (export "sum") (param i32 i64 i32) (result i64)
        (i64.add (i64.extend_i32_s (local.get 0)) (i64.sub (local.get 1) (i64.extend_i32_s (local.get 2)))))
    (func (export "narrow") (param i64) (result i32) (i32.wrap_i64 (local.get 0)))
    (func (export "endless") (loop (br 0))))"""


@cache
def calls_directly() -> bool:
    """Whether wasmtime's C function does in this version what `_raw` expects of it; the log says if it does not."""
    found = version("wasmtime")
    if found.startswith(VERSION):
        store = wasmtime.Store(_engine(PAGE.bit_length()))
        module = wasmtime.Module(store.engine, _TRIED)
        calls = _functions(store, wasmtime.Instance(store, module, []).exports(store), _raw)
        results = calls["sum"]((-1, 1 << 40, 7), 100), calls["narrow"]((-5,), 100)
        try:
            calls["endless"]((), 100)
        except MachineTrap as trap:
            if results == ((1 << 40) - 8, -5) and trap.out_of_fuel:
                return True
    _log.warning(
        "modules run slowly: this wasmtime lays arguments out in an unknown way", found=found, known=VERSION
    )
    return False
