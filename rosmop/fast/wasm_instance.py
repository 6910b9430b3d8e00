"""Run one WebAssembly module, with bounds on its memory and its work.

- Work is bounded by *fuel*: about one unit for each instruction or copied byte, the same on every machine.
- Addresses for the whole limit are reserved at the start, and the memory grows in place. So an older view stays
  valid, only shorter, and keeps the memory alive after the instance is closed.
- One process translates a module into machine code (`translate`). Others run it and compile nothing.
- The library `wasmtime` is called through its C functions (0.4 µs a call, instead of 20 µs through its Python code).
  Calls hold Python's lock, so no other thread runs in an instance. The relay cannot load wasmtime's Python code: it
  has functions that C calls, for which libffi needs memory that is writable and executable. For the same reason a
  module has no imports.
- Traps come without signals, so a handler of SIGSEGV (`faulthandler`) does not interfere.
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

VERSION = "50."

_FUEL_AT_START = 1_000_000
_TABLE_ELEMENTS = 10_000
_FUNCTION, _MEMORY = 0, 3  # kinds of exports
_KINDS = {0: "i", 1: "q"}  # kinds of values: integers of 32 and 64 bits
_REASONS = ("stack overflow", "memory out of bounds", "misaligned access", "table out of bounds",
            "indirect call to null", "bad signature", "integer overflow", "integer division by zero",
            "bad conversion to integer", "unreachable", "interrupt", "out of fuel")  # fmt: skip
_OFF = ("component_model", "custom_page_sizes", "exceptions", "function_references", "gc", "memory64", "multi_memory",
        "relaxed_simd", "simd", "stack_switching", "tail_call", "threads", "wide_arithmetic")  # fmt: skip

Call = Callable[..., int | None]


class WasmError(Exception):
    """An instance or function that cannot be created."""


class WasmTrap(Exception):  # noqa: N818  its name in WebAssembly
    """A call was stopped, with the reason ("out of fuel"). Its writes to memory remain."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class WasmInstance:
    """A module, which has no imports, and the memory that it exports as `memory`, of at most `limit` bytes.

    `code` must be the result of `translate` with the same `limit`, because it is run unchecked. Raises `WasmError`,
    and `WasmTrap` if the module's start traps.
    """

    def __init__(self, code: bytes, limit: int) -> None:
        c = load()
        engine = _engine(_bits(limit))
        store = _Store(engine, limit)
        self._store: _Store | None = store
        self._functions: dict[str | int, Call] = {}
        self._natives: dict[str, tuple[int, int, int, object]] = {}
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
            raise _to_trap(trap)
        name, length, export = ctypes.c_void_p(), ctypes.c_size_t(), _Export()
        for number in count():
            out = (ctypes.byref(slot) for slot in (name, length, export))
            if not c.wasmtime_instance_export_nth(store.context, instance, number, *out):
                break
            text = ctypes.string_at(name.value or 0, length.value).decode()
            if export.kind == _FUNCTION:
                call = _bind(store, export)
                if call is not None:
                    self._natives[text] = _addresses(store, export)
                    self._functions[len(self._functions) // 2] = self._functions[text] = call
            elif export.kind == _MEMORY and text == "memory":
                self._memory = _Export.from_buffer_copy(export)
        if self._memory is None:
            raise WasmError("the module exports no memory")

    @property
    def memory(self) -> memoryview:
        """Return the memory. Read the property again after it has grown."""
        asked = self._asked()
        size = load().wasmtime_memory_data_size(*asked)
        if size != len(self._view):
            found = (ctypes.c_ubyte * size).from_address(load().wasmtime_memory_data(*asked))
            found.keeps = self._store  # as long as a view exists
            self._view = memoryview(found).cast("B")
        return self._view

    def reserve(self, size: int) -> None:
        missing = size - len(self.memory)
        _check(
            load().wasmtime_memory_grow(
                *self._asked(), max(-(-missing // PAGE), 0), ctypes.byref(ctypes.c_uint64())
            )
        )

    def call(self, name: str | int, *arguments: int, fuel: int) -> int | None:
        """Call an exported function of integers. A 32-bit parameter gets the low bits of its argument.

        Raises `WasmTrap`, `WasmError` if the function does not exist or the instance is closed, and
        `struct.error` for a wrong number of arguments, or for an argument beyond 64 bits.
        """
        function = self.function(name)
        self.refuel(fuel)
        return function(*arguments)

    def function(self, name: str | int) -> Call:
        try:
            return self._functions[name]
        except KeyError:
            self._asked()
            raise WasmError(f"the module has no function {name!r} of integers") from None

    def native(self, name: str) -> tuple[int, int, int, object]:
        """Return the addresses of `wasmtime_func_call_unchecked`, of the store and of an exported function of integers.

        They are valid while the last item of the result is referenced.
        """
        return self._natives[name]

    def refuel(self, fuel: int) -> None:
        _check(load().wasmtime_context_set_fuel(self._asked()[0], fuel))

    def close(self) -> None:
        self._functions, self._view, self._store = {}, memoryview(b""), None

    def _asked(self) -> tuple[int, Any]:
        if self._store is None or self._memory is None:
            raise WasmError("the instance is closed")
        return self._store.context, ctypes.byref(self._memory, _Export.of.offset)


class _Export(ctypes.Structure):
    _fields_ = (("kind", ctypes.c_uint8), ("of", ctypes.c_uint64 * 3))


class _Vector(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("data", ctypes.POINTER(ctypes.c_void_p)))


class _Store:
    """Owns wasmtime's objects of an instance, which are freed with the last reference."""

    def __init__(self, engine: int, limit: int) -> None:
        self._library = load()
        self._address = self._library.wasmtime_store_new(engine, None, None)
        self.context: int = self._library.wasmtime_store_context(self._address)
        self._library.wasmtime_store_limiter(self._address, limit, _TABLE_ELEMENTS, 1, 1, 1)

    def __del__(self) -> None:
        self._library.wasmtime_store_delete(self._address)


_P, _SIZE = ctypes.c_void_p, ctypes.c_size_t
_C: dict[str, tuple[Any, ...]] = {  # the result and the parameters of each function
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


def translate(code: bytes, limit: int) -> bytes:
    """Translate a module into machine code for a `WasmInstance` with this limit. The result is deterministic.

    Raises `WasmError` if the code is not a module.
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
    """Load the C functions of wasmtime. Raises `WasmError` for another version."""
    package, found = find_spec("wasmtime"), version("wasmtime")
    if package is None or package.origin is None or not found.startswith(VERSION):
        raise WasmError(f"wasmtime {VERSION}x is required, but {found} is here")
    folder = f"linux-{os.uname().machine}"
    file = str(Path(package.origin).with_name(folder) / "_libwasmtime.so")
    library = ctypes.PyDLL(file)
    # This takes seconds for a large set. Without Python's lock, the process still answers its supervisor.
    library.__dict__["wasmtime_module_new"] = ctypes.CDLL(file).wasmtime_module_new
    for name, (result, *given) in _C.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, given
    return library


def _bits(limit: int) -> int:
    return max(limit - 1, PAGE - 1).bit_length()


@cache
def _engine(bits: int) -> int:
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


def _bind(store: _Store, export: _Export) -> Call | None:
    """Return a callable for an export, or None if it has arguments or results other than integers.

    Arguments and result are in slots of 16 bytes. The wrapper must free a returned trap or error.
    """
    c = load()
    native = _Export.from_buffer_copy(export)
    function = ctypes.byref(native, _Export.of.offset)
    kind = c.wasmtime_func_type(store.context, function)
    takes, gives = (_kinds(types_of(kind)) for types_of in (c.wasm_functype_params, c.wasm_functype_results))
    c.wasm_functype_delete(kind)
    if len(gives) > 1 or None in (*takes, *gives):
        return None
    # No argument types are set, because ctypes would check them at each call.
    invoke = c["wasmtime_func_call_unchecked"]
    invoke.restype = ctypes.c_void_p
    slots = (ctypes.c_uint64 * (2 * max(len(takes), 1)))()
    slots.keeps = store, native  # type: ignore[attr-defined]  # kept alive until the call ends
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
            raise _to_trap(trap)
        return read[0]

    return call


def _addresses(store: _Store, export: _Export) -> tuple[int, int, int, object]:
    native = _Export.from_buffer_copy(export)
    invoke = ctypes.cast(load()["wasmtime_func_call_unchecked"], ctypes.c_void_p).value or 0
    return invoke, store.context, ctypes.addressof(native) + _Export.of.offset, (store, native)


def failure(error: int, trap: int) -> Exception:
    try:
        _check(error or None)
    except WasmError as found:
        return found
    return _to_trap(ctypes.c_void_p(trap))


def _kinds(vector: Any) -> list[Any]:
    found = vector.contents
    return [_KINDS.get(load().wasm_valtype_kind(found.data[number])) for number in range(found.size)]


def _check(error: int | None) -> None:
    if error is not None:
        c, text = load(), _Vector()
        c.wasmtime_error_message(error, ctypes.byref(text))
        message = ctypes.string_at(text.data, text.size).decode()
        c.wasm_byte_vec_delete(ctypes.byref(text))
        c.wasmtime_error_delete(error)
        raise WasmError(message)


def _to_trap(trap: ctypes.c_void_p) -> WasmTrap:
    c, code = load(), ctypes.c_uint8()
    c.wasmtime_trap_code(trap, ctypes.byref(code))
    c.wasm_trap_delete(trap)
    trap.value = None
    return WasmTrap(_REASONS[code.value])
