import contextlib
import resource
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import wasmtime
from hypothesis import given, settings
from hypothesis import strategies as st

from rosmop.fast import wasm_instance
from rosmop.fast.wasm_instance import PAGE, WasmError, WasmInstance, WasmTrap, translate
from rosmop.tests.examples import examples

LIMIT = 4 * PAGE
FUEL = 1_000_000

TRAPS = {
    "unreachable": "unreachable",
    "integer division by zero": "(drop (i32.div_s (i32.const 1) (i32.const 0)))",
    "integer overflow": "(drop (i32.div_s (i32.const -2147483648) (i32.const -1)))",
    "bad conversion to integer": "(drop (i32.trunc_f64_s (f64.const nan)))",
    "memory out of bounds": "(i32.store (i32.const 65533) (i32.const 1))",
    "table out of bounds": "(call_indirect (i32.const 9))",
    "indirect call to null": "(call_indirect (i32.const 0))",
    "bad signature": "(call_indirect (i32.const 1))",
    "stack overflow": "(call $self)",
    "out of fuel": "(loop (br 0))",
}


def run(code: bytes, limit: int = LIMIT) -> WasmInstance:
    return WasmInstance(translate(code, limit), limit)


def made(text: str, limit: int = LIMIT, pages: str = "1") -> WasmInstance:
    return run(bytes(wasmtime.wat2wasm(f'(module (memory (export "memory") {pages}) {text})')), limit)


def trap_of(instance: WasmInstance, name: str | int, *arguments: int, fuel: int = FUEL) -> WasmTrap:
    with pytest.raises(WasmTrap) as caught:
        instance.call(name, *arguments, fuel=fuel)
    return caught.value


def test_arguments_and_results_by_name_and_number() -> None:
    instance = made("""
        (func (export "first") (param f64))
        (func (export "mixed") (param i32 i64 i32) (result i64)
            (i64.sub (i64.mul (i64.extend_i32_s (local.get 0)) (local.get 1)) (i64.extend_i32_s (local.get 2))))
        (func (export "narrow") (param i64) (result i32) (i32.wrap_i64 (local.get 0)))
        (func (export "none"))""")
    assert instance.call("mixed", -3, 1 << 40, 7, fuel=FUEL) == -3 * (1 << 40) - 7
    assert instance.call(0, 0xFFFFFFFF, 5, -1, fuel=FUEL) == -4, "of a wider argument its 32 bits"
    assert instance.call("narrow", -1, fuel=FUEL) == instance.call(1, (1 << 32) - 1, fuel=FUEL) == -1
    assert instance.call("none", fuel=FUEL) is instance.call(2, fuel=FUEL) is None
    for name in ("first", "other", 3, "memory"):
        with pytest.raises(WasmError, match="has no function"):
            instance.call(name, fuel=FUEL)


@pytest.mark.parametrize("arguments", [(), (1, 2), (1 << 63,), (0.5,)])
def test_other_arguments(arguments: tuple[int, ...]) -> None:
    instance = made("""(func (export "mark") (param i64) (i32.store (i32.const 0) (i32.const 1)))""")
    with pytest.raises(struct.error):
        instance.call("mark", *arguments, fuel=FUEL)
    assert instance.memory[0] == 0


@pytest.mark.parametrize("reason", TRAPS)
def test_every_trap_has_its_reason_and_the_machine_goes_on(reason: str) -> None:
    instance = made(f"""(type $none (func)) (table 2 funcref) (elem (i32.const 1) $other)
        (func $other (param i32))
        (func $self (export "fail") (i32.store (i32.const 8) (i32.const 7)) {TRAPS[reason]})
        (func (export "fine") (result i32) (i32.load (i32.const 8)))""")
    for _ in range(3):
        trap = trap_of(instance, "fail", fuel=100_000_000)
        assert (trap.reason, str(trap)) == (reason, reason)
        assert instance.call("fine", fuel=FUEL) == 7


def test_each_call_has_its_own_fuel() -> None:
    instance = made("""(func (export "turns") (param i32)
        (loop (br_if 0 (local.tee 0 (i32.sub (local.get 0) (i32.const 1))))))""")

    def is_enough(fuel: int) -> bool:
        try:
            instance.call("turns", 1000, fuel=fuel)
        except WasmTrap as trap:
            assert trap.reason == "out of fuel"
            return False
        return True

    least = next(fuel for fuel in range(1000, 20_000) if is_enough(fuel))
    assert all(is_enough(least) for _ in range(3))
    assert not is_enough(least - 1)
    assert trap_of(instance, "turns", 1, fuel=0).reason == "out of fuel"


def test_bytes_that_are_copied_use_fuel() -> None:
    instance = made("""(func (export "fill") (memory.fill (i32.const 0) (i32.const 1) (i32.const 65536)))""")
    assert trap_of(instance, "fill", fuel=60_000).reason == "out of fuel"
    instance.call("fill", fuel=70_000)


def test_an_unknown_wasmtime_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another version may have another memory layout, which would be read wrongly."""
    monkeypatch.setattr(wasm_instance, "VERSION", "49.")
    with pytest.raises(WasmError, match="wasmtime 49"):
        wasm_instance.load.__wrapped__()


def test_the_memory_grows_in_place_and_views_stay_right() -> None:
    one = made("""(func (export "grow") (param i32) (result i32) (memory.grow (local.get 0)))
        (func (export "at") (param i32) (result i32) (i32.load8_u (local.get 0)))""")
    first = one.memory
    first[0] = 1
    assert one.call("grow", 1, fuel=FUEL) == 1
    second = one.memory
    assert (len(first), len(second), one.memory) == (PAGE, 2 * PAGE, second)
    one.reserve(2 * PAGE + 1)
    assert len(one.memory) == 3 * PAGE
    first[0] += 1
    second[PAGE] = 9
    assert (one.memory[0], one.call("at", 0, fuel=FUEL), one.call("at", PAGE, fuel=FUEL)) == (2, 2, 9)
    one.reserve(10)
    assert one.call("grow", 2, fuel=FUEL) == -1
    with pytest.raises(WasmError, match="failed to grow"):
        one.reserve(LIMIT + 1)
    one.reserve(LIMIT)
    assert len(one.memory) == LIMIT
    assert one.call("grow", 1, fuel=FUEL) == -1


@pytest.mark.parametrize("limit", [PAGE, 3 * PAGE, 5 * PAGE + 1])
def test_the_limit_is_whole_pages_of_what_is_given(limit: int) -> None:
    instance = made("", limit)
    instance.reserve(limit // PAGE * PAGE)
    with pytest.raises(WasmError):
        instance.reserve(limit // PAGE * PAGE + 1)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (b"(module)", "magic header"),
        (b"\0asm\1\0\0\0junk", "malformed section|unexpected end"),
        ("(module)", "exports no memory"),
        ('(module (memory (export "memory") 5))', "memory minimum size"),
        ('(module (memory (export "memory") 1) (table 10001 funcref))', "table minimum size"),
        ('(module (memory (export "memory") 1) (memory 1))', "multi-memory|multiple memories"),
        ('(module (import "" "clock" (func)) (memory (export "memory") 1))', "expected 1 imports"),
    ],
)
def test_an_invalid_module_is_refused(code: str | bytes, reason: str) -> None:
    with pytest.raises(WasmError, match=reason):
        run(code if isinstance(code, bytes) else bytes(wasmtime.wat2wasm(code)))


def test_the_start_function_of_a_module_is_bounded() -> None:
    with pytest.raises(WasmTrap) as caught:
        made("(func $begin (loop (br 0))) (start $begin)")
    assert caught.value.reason == "out of fuel"


@pytest.mark.nightly
def test_other_threads_go_on_while_a_module_is_translated() -> None:
    """Translating a large set takes seconds, in which the compiler's process must answer its supervisor."""
    step = "(local.set 0 (i64.add (i64.mul (local.get 0) (i64.const 3)) (i64.const 7)))"
    functions = "".join(f'(func (export "f{number}") (param i64) {step * 400})' for number in range(600))
    code = bytes(wasmtime.wat2wasm(f'(module (memory (export "memory") 1) {functions})'))
    taken: list[float] = []

    def work() -> None:
        began = time.thread_time()
        translate(code, LIMIT)
        taken.append(time.thread_time() - began)

    thread, began = threading.Thread(target=work), time.thread_time()
    thread.start()
    while not taken:
        pass
    thread.join()
    assert time.thread_time() - began > taken[0] / 4


def test_a_view_outlives_its_machine() -> None:
    instance = made("")
    view = instance.memory[10:20]
    view[0] = 3
    instance.close()
    instance.close()
    many = [made("", pages="4") for _ in range(50)]
    assert (view[0], len(many)) == (3, 50)
    for use in (lambda: instance.memory, lambda: instance.reserve(1), lambda: instance.call("f", fuel=1)):
        with pytest.raises(WasmError, match="closed"):
            use()


def test_machines_share_an_engine_and_nothing_else() -> None:
    text = """(global $n (mut i32) (i32.const 0))
        (func (export "count") (result i32) (global.set $n (i32.add (global.get $n) (i32.const 1))) (global.get $n))
        (func (export "trap") unreachable)"""
    one, other = made(text), made(text)
    assert [one.call("count", fuel=FUEL) for _ in range(3)] == [1, 2, 3]
    trap_of(one, "trap")
    one.memory[0] = 1
    one.close()
    assert (other.call("count", fuel=FUEL), other.memory[0]) == (1, 0)


RICH = bytes(
    wasmtime.wat2wasm(f"""(module (type $none (func)) (memory (export "memory") 1) (data (i32.const 8) "data")
    (table 2 funcref) (elem (i32.const 1) $fill) (global $n (mut i64) (i64.const 5))
    (func $fill (export "fill") (param i32 i32) (memory.fill (local.get 0) (i32.const 1) (local.get 1)))
    (func (export "copy") (param i32 i32 i32) (memory.copy (local.get 0) (local.get 1) (local.get 2)))
    (func (export "grow") (param i32) (result i32) (memory.grow (local.get 0)))
    (func (export "sum") (param i32 i64) (result i64) (local $a i64)
        (loop (local.set $a (i64.add (local.get $a) (i64.load offset=8 (local.get 0)))) (call $fill (local.get 0)
        (i32.const 3)) (br_if 0 (local.tee 0 (i32.sub (local.get 0) (i32.const 1)))))
        (global.set $n (i64.add (global.get $n) (local.get $a))) (global.get $n))
    (func $self (export "all") {" ".join(TRAPS.values())}))""")
)


@settings(max_examples=examples(300))
@given(
    changes=st.lists(st.tuples(st.integers(0, len(RICH) - 1), st.integers(0, 255)), max_size=4),
    length=st.sampled_from([len(RICH)] * 9 + [len(RICH) // 2]),
    argument=st.sampled_from([0, 1, -1, 5, PAGE - 4, PAGE, 1 << 31, (1 << 63) - 1]),
)
def test_damaged_modules(changes: list[tuple[int, int]], length: int, argument: int) -> None:
    code = bytearray(RICH)
    for at, value in changes:
        code[at] = value
    other = made("", PAGE)
    with contextlib.suppress(WasmError, WasmTrap):
        instance = run(bytes(code[:length]))
        for number in range(8):
            for arguments in ((), (argument,), (argument, 3), (argument, 3, argument)):
                with contextlib.suppress(WasmError, WasmTrap, struct.error):
                    instance.call(number, *arguments, fuel=10_000)
        assert len(instance.memory) <= LIMIT
        instance.memory[:] = bytes(len(instance.memory))
    assert bytes(other.memory) == bytes(PAGE)


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_calls_and_traps_leave_nothing_behind() -> None:
    instance = made("""(func $deep (export "fail") (param i32)
            (if (local.get 0) (then (call $deep (i32.sub (local.get 0) (i32.const 1))))) unreachable)
        (func (export "fine"))""")

    def use(calls: int, machines: int) -> None:
        for _ in range(calls):
            instance.call("fine", fuel=FUEL)
            try:
                instance.call("fail", 1, fuel=FUEL)
            except WasmTrap:
                continue
        for _ in range(machines):
            made("", pages="4").memory[::4096] = bytes(LIMIT // 4096)

    use(5_000, 50)
    before = resident()
    use(100_000, 500)
    assert resident() - before < 4 << 20, "40 bytes for each of 100,000, or 8 KiB for each of 500"


@pytest.mark.nightly
def test_many_machines_need_few_addresses() -> None:
    done = subprocess.run(
        [sys.executable, "-c", f"""
import resource, wasmtime
from rosmop.fast.wasm_instance import WasmInstance, translate
code = bytes(wasmtime.wat2wasm('(module (memory (export "memory") 1) (func (export "f") unreachable))'))
code = translate(code, 1 << 20)
WasmInstance(code, 1 << 20)
had = int(open("/proc/self/statm").read().split()[0]) * {resource.getpagesize()}
resource.setrlimit(resource.RLIMIT_AS, (had + (400 << 20), had + (400 << 20)))
machines = [WasmInstance(code, 1 << 20) for _ in range(250)]
for one in machines:
    one.reserve(1 << 20)
    one.memory[-1] = 1
print(len(machines))
"""],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("250\n", "")


@pytest.mark.nightly
def test_traps_come_without_signals() -> None:
    """A signal handler installed later, which would end the process, is never called."""
    fails = "".join(f'(func (export "{name}") {TRAPS[name]})' for name in list(TRAPS)[:5])
    done = subprocess.run(
        [sys.executable, "-c", f"""
import faulthandler, wasmtime
from rosmop.fast.wasm_instance import WasmInstance, WasmTrap, translate
code = bytes(wasmtime.wat2wasm({f'(module (memory (export "memory") 1) {fails})'!r}))
one = WasmInstance(translate(code, 1 << 16), 1 << 16)
faulthandler.enable()
for number in range(5):
    try:
        one.call(number, fuel=1000)
    except WasmTrap as trap:
        print(trap)
"""],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (done.stdout.splitlines(), done.stderr) == (list(TRAPS)[:5], "")
