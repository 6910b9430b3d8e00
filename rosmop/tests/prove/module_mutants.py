"""Modules with one fault: every mistake that a generator of modules may make in an instruction."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice

from rosmop.check.sources import compiled_from
from rosmop.fast.batch_codegen import WasmModule, written_of
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import groups
from rosmop.prove.decoding import Code, WasmInstruction, functions_of
from rosmop.prove.equality import EQUAL, Validation
from rosmop.run.engine import MonitorSet
from rosmop.tests.prove.encoding import with_function
from rosmop.tests.random_specifications import definitions
from roswire.definitions import Definitions

_COMPARED = ("eq", "ne", "lt", "le", "gt", "ge")
_OTHER = {"add": "sub", "sub": "add", "mul": "add", "div": "mul", "and": "or", "or": "and", "xor": "or", "shl": "shr_u",
          "neg": "abs", "abs": "neg", "floor": "ceil", "ceil": "floor", "rem": "div"}  # fmt: skip


def _comparison(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    family, _, name = instruction.name.partition(".")
    name, _, sign = name.partition("_")
    if name in _COMPARED:
        other = _COMPARED[_COMPARED.index(name) ^ 1]
        needs = other not in ("eq", "ne") and family[0] == "i"
        yield replace(instruction, name=f"{family}.{other}" + (f"_{sign or 's'}" if needs else ""))
        if name in ("lt", "gt", "le", "ge"):
            turned = {"lt": "gt", "gt": "lt", "le": "ge", "ge": "le"}[name]
            yield replace(instruction, name=f"{family}.{turned}" + (f"_{sign}" if sign else ""))


def _operation(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    family, _, name = instruction.name.partition(".")
    name, _, sign = name.partition("_")
    if name in _OTHER and family in ("i32", "i64", "f32", "f64"):
        other = _OTHER[name]
        yield replace(
            instruction, name=f"{family}.{other}" + (f"_{sign}" if other in ("div", "rem") and sign else "")
        )


def _sign(one: WasmInstruction) -> Iterator[WasmInstruction]:
    if one.name.endswith(("_s", "_u")) and one.name not in ("i32.extend8_s", "i32.extend16_s"):
        yield replace(one, name=one.name[:-1] + ("u" if one.name.endswith("s") else "s"))


def _width(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    widths = {
        "i32.load": "i32.load16_u", "i32.load8_u": "i32.load16_u", "i32.load16_u": "i32.load8_u",
        "i32.load8_s": "i32.load16_s", "i32.load16_s": "i32.load8_s", "i32.store8": "i32.store16",
        "i32.store16": "i32.store", "i32.store": "i32.store16", "i32.extend8_s": "i32.extend16_s",
        "i32.extend16_s": "i32.extend8_s",
    }  # fmt: skip
    if instruction.name in widths:
        yield replace(instruction, name=widths[instruction.name])


def _offset(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    if ".load" in instruction.name or ".store" in instruction.name:
        yield replace(instruction, operands=(instruction.operands[0] + 1,))
        yield replace(instruction, operands=(instruction.operands[0] + 8,))


def _constant(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    if instruction.name.endswith(".const"):
        yield replace(instruction, operands=(instruction.operands[0] + 1,))
        if instruction.operands[0]:
            yield replace(instruction, operands=(-instruction.operands[0],))


def _check(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
    if instruction.name == "if" and instruction.body:
        if not instruction.otherwise:
            yield WasmInstruction("drop")
        yield replace(instruction, body=instruction.otherwise, otherwise=instruction.body)


FAULTS: dict[str, Callable[[WasmInstruction], Iterator[WasmInstruction]]] = {
    "comparison": _comparison, "operation": _operation, "sign": _sign, "width": _width, "offset": _offset,
    "constant": _constant, "check": _check,
}  # fmt: skip


def _trees(
    body: Sequence[WasmInstruction], change: Callable[[WasmInstruction], Iterator[WasmInstruction]]
) -> Iterator[tuple[WasmInstruction, ...]]:
    for place, one in enumerate(body):
        before, after = tuple(body[:place]), tuple(body[place + 1 :])
        changed = [*change(one)]
        changed += [replace(one, body=inner) for inner in _trees(one.body, change)]
        changed += [replace(one, otherwise=inner) for inner in _trees(one.otherwise, change)]
        for other in changed:
            yield (*before, other, *after)


def operands(code: Code) -> Iterator[tuple[WasmInstruction, ...]]:
    """Each fault reads the next variable of the same type."""
    kinds = [*code.parameters, *code.made]

    def change(instruction: WasmInstruction) -> Iterator[WasmInstruction]:
        if instruction.name == "local.get":
            place = int(instruction.operands[0])
            same = [other for other, kind in enumerate(kinds) if kind == kinds[place] and other != place]
            if same:
                yield replace(instruction, operands=(same[place % len(same)],))

    yield from _trees(code.body, change)


def mutants(code: Code) -> Iterator[tuple[str, Code]]:
    for kind, change in FAULTS.items():
        for body in _trees(code.body, change):
            yield kind, replace(code, body=body)
    for body in operands(code):
        yield "operand", replace(code, body=body)


def event(body: str, parameters: str, pattern: str, before: str = "") -> str:
    return f"s() {{ {before} event e({parameters}) /plain own/Plain '{{{pattern}}}' {{ {body} }} }}"


FAULTY = {
    "fields, variables, a drop": event(
        "if (x < 3) { return; } if (y > 2.5) { y = -y; } n = n + (uint16_t) x; x = n ^ 7; b = n == x;",
        "int x, double y", "count:x, x:y", "int n = 0; bool b = false;",
    ),
    "a string and what stands behind it": """s() { int n = 0; double d = 0;
        event e(std::string f, double a) /stamped own/Stamped '{frame:f, values[1]:a}' when (f == "abc") {
            n = f.size(); d = a; } }""",
    "names that are kept, and seconds": """s() { std::string last; double at = 0; int n = 0;
        event e() /plain own/Plain '{}' { std::string node = caller(e) == "" ? "a" : caller(e);
        if (last == "" || last == node) { last = node; at = ros::Time::now().toSec(); } else { n++; return; } } }""",
    "output, and what the module leaves": event(
        'if (x > 3) { ROS_INFO("%d", x + 1); n += x; } if (n > 7) { ROS_WARN("%d %d", n, x); }'
        " if (n == 5) { PUBLISH(/told, std_msgs/Int32, told); }",
        "int x", "count:x", "std_msgs::Int32 told; int n = 0;",
    ),
}  # fmt: skip


def compiled(text: str, known: Definitions | None = None) -> Compiled:
    known = definitions() if known is None else known
    return MonitorSet.of(compiled_from({"a.rv": text}, known)).compiled


def faulty(text: str, every: int = 1) -> Iterator[tuple[str, str]]:
    return faulty_event(compiled(text), "e", every)


def faulty_event(
    code: Compiled, event: str, every: int, *, patience: float = 100
) -> Iterator[tuple[str, str]]:
    [group] = groups(code.specifications)
    module = written_of(code)
    [(topic, meant, place)] = [
        (topic, code.specifications[number].events[index], place)
        for (topic, _), numbers in zip(group.component.topics, group.events, strict=True)
        for place, (number, index) in enumerate(numbers)
        if code.specifications[number].events[index].name == event
    ]

    def answer(module: WasmModule) -> str:
        validation = Validation(code, module, patience)
        return validation.finding(topic, event, meant, place).answer

    assert answer(module) == EQUAL
    codes = functions_of(module.code)
    wrong = (
        (number, kind, other)
        for number in _called(codes, module.feeds[topic].functions[place])
        if number not in module.routines.values()  # the proof takes these as given
        for kind, other in mutants(codes[number])
    )
    for number, kind, other in islice(wrong, 0, None, every):
        yield kind, answer(replace(module, code=with_function(module.code, number, other))).partition(":")[0]


def _called(codes: Sequence[Code], number: int) -> list[int]:
    found = [number]
    for one in found:
        found += {called for called in _calls(codes[one].body) if called not in found}
    return found


def _calls(body: Sequence[WasmInstruction]) -> Iterator[int]:
    for one in body:
        if one.name == "call":
            yield int(one.operands[0])
        yield from _calls((*one.body, *one.otherwise))
