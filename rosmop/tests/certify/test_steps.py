from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, islice, product
from typing import Any

import msgspec
import pytest

from rosmop.certify.steps import StepDiffersError, check_steps
from rosmop.check.sources import compiled_from
from rosmop.fast import batch_codegen, build
from rosmop.fast.batch_codegen import WasmModule, write
from rosmop.fast.wasm_instance import WasmError
from rosmop.form import nodes, specification_groups
from rosmop.form.compiled import Compiled
from rosmop.form.findings import SpecificationError
from rosmop.form.specification_groups import groups
from rosmop.run.engine import MonitorSet
from rosmop.runtime.values import ValueCodec
from rosmop.tests.certify.step_mutants import tables, walks
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import Specifications, definitions

GUARD = """s() { int n = 0;
    event a(int x) /plain own/Plain '{kind:0, count:x}' { if (x > 8) { return; } }
    event b(int x) /plain own/Plain '{kind:1, count:x}' { n = x; }
    ptltl: b => <*> a @violation { DROP; }
    fsm: idle [a -> moved, b -> idle] moved [b -> lock, a -> moved] lock [a -> lock, b -> idle]
    @lock { n = 1; DROP; __RESET; } @fail { n = 2; }
    pattern: globally: a forbids b within 5s @validation { }
}"""


def compiled(*texts: str) -> Compiled:
    return MonitorSet.of(
        compiled_from({f"{place}.rv": text for place, text in enumerate(texts)}, definitions())
    ).compiled


def module(of: Compiled) -> WasmModule:
    return write(
        of.functions, [group.component for group in groups(of.specifications)], ValueCodec(of.messages)
    )


def test_the_modules_of_random_specifications_pass() -> None:
    steps = 0
    for seed, numbers in product(range(examples(60)), (True, False)):
        texts = Specifications(seed, numbers=numbers).texts()
        try:
            of = compiled(*texts)
        except SpecificationError:  # a random specification may break a rule
            continue
        steps += check_steps(of, module(of))
    assert steps > examples(9000)


def test_a_large_table_is_run_in_all_of_its_states() -> None:
    states = " ".join(f"q{n} [a -> q{(n + 1) % 900}, b -> q{n * 7 % 900}]" for n in range(900))
    of = compiled(f"{GUARD.split('ptltl', maxsplit=1)[0]} fsm: {states} @q5 {{ DROP; }} }}")
    assert check_steps(of, module(of)) > 900 * 2
    wrong = list(islice(tables(module(of)), 0, None, 331))
    assert len(wrong) > 5
    for _, where, one in wrong:
        with pytest.raises(StepDiffersError):
            check_steps(of, one)
            raise AssertionError(where)


def test_mutants_of_walks_and_tables_are_rejected() -> None:
    """The remaining mutants only change explanations, budgets or cells that are overwritten, or cannot occur here."""
    of = compiled(GUARD)
    whole, came = module(of), Counter[str]()
    every = 6 // examples(6)
    for kind, _, one in islice(chain(tables(whole), walks(whole)), 0, None, every):
        try:
            check_steps(of, one)
        except StepDiffersError:
            came[kind] += 1
        except WasmError:
            came["no module"] += 1
        else:
            came["passes"] += 1
    rejected = sum(
        came[kind] for kind in ("table", "operation", "constant", "local", "address", "branch", "call")
    )
    assert rejected > 900 // every
    assert rejected > came["passes"]


def _changed(change: Callable[[nodes.Advance], nodes.Advance]) -> Callable[..., nodes.Event]:
    event = specification_groups.event_of

    def changed(*arguments: Any) -> nodes.Event:
        made = event(*arguments)
        return msgspec.structs.replace(made, advances=tuple(map(change, made.advances)))

    return changed


def _advance(**fields: Callable[[nodes.Advance], object]) -> Callable[..., nodes.Event]:
    return _changed(
        lambda one: msgspec.structs.replace(one, **{name: value(one) for name, value in fields.items()})
    )


# `local.get` and `local.set`: the walk continues at the next message, and writes nothing.
NEXT_MESSAGE = bytes((0x20, 6, 0x21, 0))
ADVANCE = (specification_groups, "event_of")
FAULTS: dict[str, tuple[object, str, object]] = {
    "another column of the table": (*ADVANCE, _advance(table=lambda one: one.table[1:] + one.table[:1])),
    "another initial state": (*ADVANCE, _advance(initial=lambda one: one.initial + 1)),
    "no handler runs": (*ADVANCE, _advance(handlers=lambda _: ())),
    "a handler in another state": (*ADVANCE, _advance(
        handlers=lambda one: tuple(
            msgspec.structs.replace(handler, states=frozenset({0})) for handler in one.handlers
        )
    )),
    "handlers in another order": (*ADVANCE, _advance(handlers=lambda one: one.handlers[::-1])),
    "formulas keep dropped messages": (*ADVANCE, _advance(suppresses=lambda _: False)),
    "machines forget dropped messages": (*ADVANCE, _advance(suppresses=lambda _: True)),
    "properties in another order": (*ADVANCE, _advance(property=lambda one: 1 - (one.property or 0))),
    "a drop has no effect": (batch_codegen.TopicCodegen, "_drop", lambda *_: b""),
    "handlers are not called": (batch_codegen.TopicCodegen, "_handle", lambda *_: b""),
    "properties do not step": (batch_codegen.TopicCodegen, "_advance", lambda *_: b""),
    "states are not written": (batch_codegen.TopicCodegen, "_done", lambda self: NEXT_MESSAGE),
}  # fmt: skip

TWO = """s() { event a(int x) /plain own/Plain '{kind:0, count:x}' { if (x > 8) { return; } }
    event b() /plain own/Plain '{kind:1}' { } event c() /plain own/Plain '{kind:2}' { }
    ptltl: b => <*> a @violation { DROP; } @validation { }
    fsm: idle [a -> moved, b -> idle, c -> idle] moved [b -> lock, a -> moved, c -> idle]
         lock [a -> lock, b -> idle, c -> moved]
    alias any = lock, idle
    @lock { DROP; __RESET; } @any { } @fail { } }"""


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_one_line_are_rejected(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    of = compiled(TWO)
    assert build.part_of(of, ["s"], [])
    monkeypatch.setattr(*FAULTS[fault])
    with pytest.raises(StepDiffersError):
        build.part_of(of, ["s"], [])


def test_functions_in_another_order_are_rejected() -> None:
    of = compiled(GUARD)
    whole = module(of)
    walk = whole.feeds["/plain"]
    with pytest.raises(StepDiffersError, match="the functions it calls"):
        check_steps(of, replace(whole, feeds={"/plain": replace(walk, functions=walk.functions[::-1])}))
