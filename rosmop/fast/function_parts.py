"""Write the parts that all functions have: local variables, branches, loops, charges."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

from rosmop.fast.memory_layout import MemoryLayout, NotCompiledError
from rosmop.fast.wasm import (
    BLOCK,
    ELSE,
    END,
    I32,
    I64,
    I64_DIV_U,
    I64_EQZ,
    I64_GT_U,
    I64_LT_S,
    I64_SUB,
    IF,
    LOOP,
    NOTHING,
    RETURN,
    UNREACHABLE,
    br,
    br_if,
    constant,
    load,
    local_get,
    local_set,
    store,
)
from rosmop.form import nodes
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, UNMEASURED

ELSEWHERE = 8


class FunctionBuilder(ABC):
    """Writes a function, such as an event or handler (`answers`); its steps are charged to the budget `context`."""

    def __init__(
        self, layout: MemoryLayout, parameters: Mapping[str, int], context: str, *, answers: bool
    ) -> None:
        self._layout = layout
        self._context = context
        self._answers = answers
        self._locals = {name: (index, kind) for index, (name, kind) in enumerate(parameters.items())}
        self._depth = 0  # the number of open blocks
        self._loops: list[int] = []  # the depth of each loop's block
        self._assigned: set[str] = set()  # variables of the set, and local vectors and messages
        self._brief = True

    @abstractmethod
    def _block(self, statements: Sequence[nodes.Statement]) -> bytes: ...

    @abstractmethod
    def _value(self, node: nodes.Expression) -> bytes:
        """Push the value. Raises `NotCompiledError` unless it is a number."""

    @abstractmethod
    def _routine(
        self, parameters: tuple[int, ...], write: Callable[..., bytes], *given: object, result: int = I32
    ) -> bytes:
        """Call a function with parameters of these types. `write` writes it from the arguments `given`."""

    def _local(self, name: str, machine: int) -> int:
        number, known = self._locals.setdefault(name, (len(self._locals), machine))
        if known != machine:
            raise NotCompiledError("gives a variable values of two types")
        return number

    def _get(self, name: str, machine: int = I32) -> bytes:
        return local_get(self._local(name, machine))

    def _set(self, name: str, machine: int = I32) -> bytes:
        return local_set(self._local(name, machine))

    def _when(self, test: bytes, yes: Callable[[], bytes], no: Callable[[], bytes] | None = None) -> bytes:
        self._depth += 1
        inner = yes() + (ELSE + no() if no is not None else b"")
        self._depth -= 1
        return test + IF + NOTHING + inner + END

    def _elsewhere(self) -> bytes:
        return constant(I32, ELSEWHERE) + RETURN if self._answers else UNREACHABLE

    def _spend(self, instructions: bytes) -> bytes:
        budget = self._layout.budget(self._context)
        left = store(I64, budget, load(I64, budget) + instructions + I64_SUB)
        return left + self._when(load(I64, budget) + constant(I64, 0) + I64_LT_S, self._elsewhere)

    def _allocated(self, size: bytes) -> bytes:
        """Charge for the bytes (i64) of a new value.

        Leave the message to the interpreter if the specification's memory must be measured.
        """
        many = size + constant(I64, UNMEASURED) + I64_GT_U
        spent = size + constant(I64, BYTES_PER_INSTRUCTION) + I64_DIV_U
        return self._when(many, self._elsewhere) + self._spend(spent)

    def _times(self, left: str, each: bytes, body: Sequence[nodes.Statement] = ()) -> bytes:
        over = self._get(left, I64) + I64_EQZ + br_if(1)
        less = self._get(left, I64) + constant(I64, 1) + I64_SUB + self._set(left, I64)
        return self._repeated(over + less + each, body)

    def _repeated(self, before: bytes, body: Sequence[nodes.Statement]) -> bytes:
        self._depth += 2
        self._loops.append(self._depth)
        code = before + self._block(body)
        self._loops.pop()
        self._depth -= 2
        return BLOCK + LOOP + code + br(0) + END + END
