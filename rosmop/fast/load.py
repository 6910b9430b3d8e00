"""Load the part of a set that a process runs (`rosmop.fast.build`), without the compiler."""

from rosmop.fast.abi import SetPart
from rosmop.fast.serialization import decoded_part
from rosmop.fast.wasm_instance import load
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled


def prepare() -> None:
    """Load the WebAssembly library, which takes time. Raises `WasmError`."""
    load()


def loaded(data: bytes) -> tuple[Compiled, WasmFastPath]:
    """Without data, the set is empty. Raises `ValueError` if the data are not a part."""
    part = decoded_part(data) if data else SetPart.empty()
    return part.compiled, WasmFastPath(part.module)
