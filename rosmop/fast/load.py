"""Load the part of a set that a process runs (`rosmop.fast.build`), without the compiler."""

from rosmop.fast.abi import SetPart
from rosmop.fast.serialization import decoded_part
from rosmop.fast.wasm_instance import load
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled


def prepare() -> None:
    load()


def load_part(data: bytes) -> tuple[Compiled, WasmFastPath]:
    """Load a part, or the empty set without data. Raises `ValueError` for other data."""
    part = decoded_part(data) if data else SetPart.empty()
    return part.compiled, WasmFastPath(part.module)
