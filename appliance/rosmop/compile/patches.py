"""A field that an event writes, in two steps: what it will be, and, when nothing can come between, writing it.

The outcome of a message is "changed" if its bytes differ. Whether they will is seen from the values where bytes and
values follow from each other; where they may not (a NaN, a zero whose sign changes), the message is the engine's.
"""

from dataclasses import dataclass

from appliance.rosmop.compile.module import Module
from appliance.rosmop.ir.values import struct_size

Line = tuple[int, str]
"""A line and how much deeper it stands."""


@dataclass(frozen=True)
class Patch:
    """A field that is written if `flag` is set.

    `packed` is code for the bytes of `value`; `before` the name of the value as it was read, where the bytes follow
    from it; `at` the place in `buffer`.
    """

    number: int
    flag: str
    code: str
    value: str
    packed: str
    before: str | None
    buffer: str
    at: str

    @property
    def differs(self) -> str:
        """The name of the answer."""
        return f"c_{self.number}"

    @property
    def new(self) -> str:
        """The name of the value, or of the bytes, to be written."""
        return f"w_{self.number}"

    @property
    def area(self) -> str:
        """The bytes of the field."""
        return f"{self.buffer}[{self.at}:{self.at} + {struct_size(self.code)}]"


def comparable(code: str) -> bool:
    """Whether equal values of this `struct` code have equal bytes (zeros and NaN apart)."""
    return len(code) == 1 and code in "bBhHiIqQfd"


def foreseen(patch: Patch, module: Module) -> list[Line]:
    """Whether the bytes will be others; `break` while changes are told in full (`loud`), and where it is unsure."""
    new, before = patch.new, patch.before
    lines = [(0, f"{patch.differs} = False"), (0, f"if {patch.flag}:")]
    if before is None:
        return [
            *lines,
            (1, f"{new} = {patch.packed}"),
            (1, f"{patch.differs} = {patch.area} != {new}"),
            (1, f"if {patch.differs} and loud: break"),
        ]
    lines += [(1, f"{new} = {patch.value}"), (1, f"if {new} != {before}:")]
    if patch.code not in "fd":
        return [*lines, (2, "if loud: break"), (2, f"{patch.differs} = True")]
    pack = module.struct(f"<{patch.code}", "pack")
    return [
        *lines,
        (2, f"if loud or {new} != {new} or {before} != {before}: break"),
        (2, f"{patch.differs} = True"),
        (1, f"elif not {new} and {pack}({new}) != {pack}({before}): break"),
    ]


def written(patch: Patch, module: Module, *, writer: int | None, read_again: bool) -> list[Line]:
    """Write it. With a `writer`, note that it was this event and how to take it back; with `read_again`, later events
    see the new value."""
    lines = [(0, f"if {patch.differs}:")]
    if patch.before is None:
        put, old = "w_put", f"e_bytes({patch.area})"
        change = f"{patch.area} = {patch.new}"
    else:
        put, old = module.struct(f"<{patch.code}", "pack_into"), patch.before
        change = f"{put}({patch.buffer}, {patch.at}, {patch.new})"
    if writer is not None:
        size = struct_size(patch.code)
        lines.append((1, f"who |= {1 << writer}"))
        lines.append((1, f"undo += (({put}, {patch.buffer}, {patch.at}, {old}, {size}),)"))
    lines.append((1, change))
    if read_again and patch.before is not None:
        lines.append((1, f"{patch.before} = {patch.new}"))
    return lines
