"""One WebAssembly module that runs: its memory to write into, its functions to call, bounds on both.

Theory of operation:

- Work is bounded by *fuel*, which is used up by what the module does (about one for an instruction or a byte that is
  copied), the same on every machine. Memory is bounded by a limit. What goes beyond is a `MachineTrap`.
- The addresses of the whole limit are reserved at the start and the memory grows in place: a view of it is never
  wrong, an older one is only shorter. A view keeps the memory when the machine is closed.
- A module becomes code of this machine (`translated`) in one process, and runs (`Machine`) in others, which compile
  nothing.
- The library of the package `wasmtime` is called by its C functions (0.4 µs a call, 20 by its Python) under Python's
  lock: no other thread is ever within a machine. Its Python could not be loaded in the relay: it has functions that
  C calls, for which libffi wants memory that is writable and executable at once. So a module has no imports, either.
- Traps come without signals: a handler of SIGSEGV (`faulthandler`) is not in the way.
"""

import ctypes
import os
import struct
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

PAGE = 1 << 16
"""Memory grows by so many bytes."""

VERSION = "50."
"""How the versions of wasmtime begin whose functions and layouts these are."""

_FUEL_AT_START = 1_000_000
_TABLE_ELEMENTS = 10_000
_FUNCTION, _MEMORY = 0, 3  # kinds of exports
_KINDS = {0: "i", 1: "q"}  # of values: integers of 32 and 64 bits
_REASONS = ("stack overflow", "memory out of bounds", "misaligned access", "table out of bounds",
            "indirect call to null", "bad signature", "integer overflow", "integer division by zero",
            "bad conversion to integer", "unreachable", "interrupt", "out of fuel")  # fmt: skip
_OFF = ("component_model", "custom_page_sizes", "exceptions", "function_references", "gc", "memory64", "multi_memory",
        "relaxed_simd", "simd", "stack_switching", "tail_call", "threads", "wide_arithmetic")  # fmt: skip

Call = Callable[..., int | None]
"""A function of integers, which takes them in order and goes on with the fuel that there is (`Machine.refuel`)."""


class MachineError(Exception):
    """There is no such machine or function; the text says why."""


class MachineTrap(Exception):  # noqa: N818  its name in WebAssembly
    """A call was stopped; what it had written stays.

    `reason` says why ("integer division by zero", "out of fuel").
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Machine:
    """A module, which has no imports, and the memory that it exports as `memory`.

    `code` is what `translated` has made, with the same `limit`; nothing else may be given, for it is run as it is.
    `limit` is how large the memory may become, in bytes. Raises `MachineError`, and `MachineTrap` for what the module
    does at its start.
    """

    def __init__(self, code: bytes, limit: int) -> None:
        c = load()
        engine = _engine(_bits(limit))
        store = _Store(engine, limit)
        self._store: _Store | None = store
        self._functions: dict[str | int, Call] = {}
        self._memory: _Export | None = None
        self._view = memoryview(b"")
        module, instance, trap = ctypes.c_void_p(), (ctypes.c_uint64 * 2)(), ctypes.c_void_p()
        _check(c.wasmtime_module_deserialize(engine, code, len(code), ctypes.byref(module)))
        try:
            _check(c.wasmtime_context_set_fuel(store.context, _FUEL_AT_START))
            _check(c.wasmtime_instance_new(store.context, module, None, 0, instance, ctypes.byref(trap)))
        finally:
            c.wasmtime_module_delete(module)
        if trap:
            raise _trapped(trap)
        name, length, export = ctypes.c_void_p(), ctypes.c_size_t(), _Export()
        for number in count():
            out = (ctypes.byref(slot) for slot in (name, length, export))
            if not c.wasmtime_instance_export_nth(store.context, instance, number, *out):
                break
            text = ctypes.string_at(name.value or 0, length.value).decode()
            if export.kind == _FUNCTION:
                call = _bound(store, export)
                if call is not None:
                    self._functions[len(self._functions) // 2] = self._functions[text] = call
            elif export.kind == _MEMORY and text == "memory":
                self._memory = _Export.from_buffer_copy(export)
        if self._memory is None:
            raise MachineError("the module exports no memory")

    @property
    def memory(self) -> memoryview:
        """All of the memory, to read and write; ask again when it has grown. Raises `MachineError` when closed."""
        asked = self._asked()
        size = load().wasmtime_memory_data_size(*asked)
        if size != len(self._view):
            found = (ctypes.c_ubyte * size).from_address(load().wasmtime_memory_data(*asked))
            found.keeps = self._store  # as long as there is a view
            self._view = memoryview(found).cast("B")
        return self._view

    def reserve(self, size: int) -> None:
        """Let the memory grow to `size` bytes or more. Raises `MachineError` beyond the limit."""
        missing = size - len(self.memory)
        _check(
            load().wasmtime_memory_grow(
                *self._asked(), max(-(-missing // PAGE), 0), ctypes.byref(ctypes.c_uint64())
            )
        )

    def call(self, name: str | int, *arguments: int, fuel: int) -> int | None:
        """The result of an exported function of integers (signed), by its name or its number among them.

        Each argument fits 64 bits with a sign; of one that the function takes in 32 bits these are given. Raises
        `MachineTrap`; `MachineError` where there is no such function or the machine is closed; `struct.error` where
        the arguments are not as many as it takes or too large.
        """
        function = self.function(name)
        self.refuel(fuel)
        return function(*arguments)

    def function(self, name: str | int) -> Call:
        """An exported function of integers, to be called often; see `call`."""
        try:
            return self._functions[name]
        except KeyError:
            self._asked()
            raise MachineError(f"the module has no function {name!r} of integers") from None

    def refuel(self, fuel: int) -> None:
        """Say how much fuel there is from now on. Raises `MachineError` when closed."""
        _check(load().wasmtime_context_set_fuel(self._asked()[0], fuel))

    def close(self) -> None:
        """Give the module back, and the memory when the last view of it is gone."""
        self._functions, self._view, self._store = {}, memoryview(b""), None

    def _asked(self) -> tuple[int, Any]:
        """How the memory is named to C."""
        if self._store is None or self._memory is None:
            raise MachineError("the machine is closed")
        return self._store.context, ctypes.byref(self._memory, _Export.of.offset)


class _Export(ctypes.Structure):
    _fields_ = (("kind", ctypes.c_uint8), ("of", ctypes.c_uint64 * 3))


class _Vector(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("data", ctypes.POINTER(ctypes.c_void_p)))


class _Store:
    """What a machine has of wasmtime; freed when nobody has it any more."""

    def __init__(self, engine: int, limit: int) -> None:
        self._library = load()
        self._address = self._library.wasmtime_store_new(engine, None, None)
        self.context: int = self._library.wasmtime_store_context(self._address)
        self._library.wasmtime_store_limiter(self._address, limit, _TABLE_ELEMENTS, 1, 1, 1)

    def __del__(self) -> None:
        self._library.wasmtime_store_delete(self._address)


_P, _SIZE = ctypes.c_void_p, ctypes.c_size_t
_C: dict[str, tuple[Any, ...]] = {  # what each function gives, and what it takes
    "wasm_byte_vec_delete": (None, _P),
    "wasm_config_new": (_P,),
    "wasm_engine_new_with_config": (_P, _P),
    "wasm_functype_delete": (None, _P),
    "wasm_functype_params": (ctypes.POINTER(_Vector), _P),
    "wasm_functype_results": (ctypes.POINTER(_Vector), _P),
    "wasm_trap_delete": (None, _P),
    "wasm_valtype_kind": (ctypes.c_uint8, _P),
    "wasmtime_context_set_fuel": (_P, _P, ctypes.c_uint64),
    "wasmtime_error_delete": (None, _P),
    "wasmtime_error_message": (None, _P, _P),
    "wasmtime_func_type": (_P, _P, _P),
    "wasmtime_instance_export_nth": (ctypes.c_bool, _P, _P, _SIZE, _P, _P, _P),
    "wasmtime_instance_new": (_P, _P, _P, _P, _SIZE, _P, _P),
    "wasmtime_memory_data": (_P, _P, _P),
    "wasmtime_memory_data_size": (_SIZE, _P, _P),
    "wasmtime_memory_grow": (_P, _P, _P, ctypes.c_uint64, _P),
    "wasmtime_module_delete": (None, _P),
    "wasmtime_module_deserialize": (_P, _P, _P, _SIZE, _P),
    "wasmtime_module_new": (_P, _P, _P, _SIZE, _P),
    "wasmtime_module_serialize": (_P, _P, _P),
    "wasmtime_store_context": (_P, _P),
    "wasmtime_store_delete": (None, _P),
    "wasmtime_store_limiter": (None, _P, *[ctypes.c_int64] * 5),
    "wasmtime_store_new": (_P, _P, _P, _P),
    "wasmtime_trap_code": (ctypes.c_bool, _P, _P),
}


def translated(code: bytes, limit: int) -> bytes:
    """A module of WebAssembly as code of this machine, for a `Machine` with this limit; the same gives the same.

    Raises `MachineError` where it is no module.
    """
    c, module, native = load(), ctypes.c_void_p(), _Vector()
    _check(c.wasmtime_module_new(_engine(_bits(limit)), code, len(code), ctypes.byref(module)))
    try:
        _check(c.wasmtime_module_serialize(module, ctypes.byref(native)))
    finally:
        c.wasmtime_module_delete(module)
    try:
        return ctypes.string_at(native.data, native.size)
    finally:
        c.wasm_byte_vec_delete(ctypes.byref(native))


@cache
def load() -> ctypes.PyDLL:
    """wasmtime's functions of C. Raises `MachineError` where it is another version."""
    package, found = find_spec("wasmtime"), version("wasmtime")
    if package is None or package.origin is None or not found.startswith(VERSION):
        raise MachineError(f"wasmtime {VERSION}x is needed, and {found} is here")
    folder = f"linux-{os.uname().machine}"
    file = str(Path(package.origin).with_name(folder) / "_libwasmtime.so")
    library = ctypes.PyDLL(file)
    # The one that takes seconds of a large set: what else the process does goes on, and it answers its supervisor.
    library.__dict__["wasmtime_module_new"] = ctypes.CDLL(file).wasmtime_module_new
    for name, (result, *given) in _C.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, given
    return library


def _bits(limit: int) -> int:
    return max(limit - 1, PAGE - 1).bit_length()


@cache
def _engine(bits: int) -> int:
    """What compiles the modules of all machines with a limit of up to 2**bits bytes."""
    settings = {
        **dict.fromkeys((f"wasm_{feature}" for feature in _OFF), 0),
        "shared_memory": 0,
        "consume_fuel": 1,
        "cranelift_nan_canonicalization": 1,  # a NaN in a message has the same bits on every machine
        "memory_guard_size": 0,
        "memory_may_move": 0,
        "memory_reservation": 1 << bits,
        "parallel_compilation": 0,  # no threads
        "signals_based_traps": 0,
    }
    config = load().wasm_config_new()
    for name, value in settings.items():
        load()[f"wasmtime_config_{name}_set"](ctypes.c_void_p(config), ctypes.c_uint64(value))
    engine: int = load().wasm_engine_new_with_config(config)
    return engine


def _bound(store: _Store, export: _Export) -> Call | None:
    """A function as it is called from Python; None if it has others than integers.

    Arguments and result stand in slots of 16 bytes; a trap or error that comes back is ours to free.
    """
    c = load()
    native = _Export.from_buffer_copy(export)
    function = ctypes.byref(native, _Export.of.offset)
    kind = c.wasmtime_func_type(store.context, function)
    takes, gives = (_kinds(types_of(kind)) for types_of in (c.wasm_functype_params, c.wasm_functype_results))
    c.wasm_functype_delete(kind)
    if len(gives) > 1 or None in (*takes, *gives):
        return None
    # Without the types of their arguments, which would be looked at in each call.
    invoke = c["wasmtime_func_call_unchecked"]
    invoke.restype = ctypes.c_void_p
    slots = (ctypes.c_uint64 * (2 * max(len(takes), 1)))()
    slots.keeps = store, native  # type: ignore[attr-defined]  # until the call is over, whoever closes the machine
    room = memoryview(slots).cast("B")
    fill = struct.Struct("<" + "q8x" * len(takes)).pack_into
    read = room.cast(gives[0]) if gives else (None,)
    trap = ctypes.c_void_p()
    given = (
        ctypes.c_void_p(store.context),
        function,
        slots,
        ctypes.c_size_t(len(slots) // 2),
        ctypes.byref(trap),
    )

    def call(*arguments: int) -> int | None:
        fill(room, 0, *arguments)
        error = invoke(*given)
        if error is not None:
            _check(error)
        if trap:
            raise _trapped(trap)
        return read[0]

    return call


def _kinds(vector: Any) -> list[Any]:
    """The kinds of values; None for one that is no integer."""
    found = vector.contents
    return [_KINDS.get(load().wasm_valtype_kind(found.data[number])) for number in range(found.size)]


def _check(error: int | None) -> None:
    if error is not None:
        c, text = load(), _Vector()
        c.wasmtime_error_message(error, ctypes.byref(text))
        message = ctypes.string_at(text.data, text.size).decode()
        c.wasm_byte_vec_delete(ctypes.byref(text))
        c.wasmtime_error_delete(error)
        raise MachineError(message)


def _trapped(trap: ctypes.c_void_p) -> MachineTrap:
    """What a trap says; it is freed."""
    c, code = load(), ctypes.c_uint8()
    c.wasmtime_trap_code(trap, ctypes.byref(code))
    c.wasm_trap_delete(trap)
    trap.value = None
    return MachineTrap(_REASONS[code.value])
