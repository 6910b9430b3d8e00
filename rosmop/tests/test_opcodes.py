import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosmop.fast import wasm
from rosmop.prove import decoding

TABLE = Path(wasm.__file__)
OTHERS = ("DROP", "RETURN", "SELECT", "UNREACHABLE", "br", "br_if", "call")
FAMILIES = ("i32", "i64", "f32", "f64", "local", "memory")


def literals(source: str) -> Iterator[str]:
    tree = ast.parse(source)
    compared = {
        id(part) for node in ast.walk(tree) if isinstance(node, ast.Compare) for part in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, bytes) and node.value:
            if id(node) not in compared:
                yield ast.unparse(node)
        elif isinstance(node, ast.Call):
            makes = ast.unparse(node.func).rpartition(".")[2]
            given = node.args[0] if node.args else None
            listed = isinstance(given, ast.Tuple | ast.List | ast.GeneratorExp | ast.ListComp)
            if makes in ("bytes", "bytearray") and listed:
                yield ast.unparse(node)
            if makes in ("signed", "unsigned") and isinstance(given, ast.Constant):
                yield ast.unparse(node)
            if makes in ("pack", "to_bytes") and any(
                isinstance(part, ast.Constant) and isinstance(part.value, int) for part in ast.walk(node)
            ):
                yield ast.unparse(node)


@pytest.mark.parametrize("path", sorted(set(TABLE.parent.glob("*.py")) - {TABLE}), ids=lambda path: path.stem)
def test_opcodes_are_in_the_table(path: Path) -> None:
    assert list(literals(path.read_text())) == []


@pytest.mark.parametrize(
    "source",
    [
        r'code += b"\x6a"', "bytes((0x28, 0))", "bytes([opcode])", "bytes((COMPARE[I32]['=='],))", "unsigned(0x20)",
        "wasm.signed(1)", "struct.pack('<B', 0x6A)", "(0x6A).to_bytes(1, 'little')", "bytes(code for code in codes)",
    ],
)  # fmt: skip
def test_literals_are_found(source: str) -> None:
    assert list(literals(source))


@pytest.mark.parametrize(
    "source",
    ['part.value == b"sec"', "bytes(memory[at:end])", 'b"".join(parts)', "br(1)", "unsigned(len(raw))"],
)
def test_other_bytes_are_not_opcodes(source: str) -> None:
    assert not list(literals(source))


def named(name: str) -> str:
    family, _, rest = name.lower().partition("_")
    return f"{family}.{rest}" if rest and family in FAMILIES else name.lower()


@pytest.mark.parametrize("name", [name for name in vars(wasm) if "." in named(name) or name in OTHERS])
def test_instructions_have_their_names(name: str) -> None:
    instruction = getattr(wasm, name)
    code = instruction if isinstance(instruction, bytes) else instruction(300)
    reader = decoding.Reader(code)
    wasm_instruction = reader.instruction(reader.byte())
    assert wasm_instruction.name == named(name)
    assert isinstance(instruction, bytes) or wasm_instruction.operands == (300,)
    assert reader.at == len(code)
