"""Print every installed message and service class as one JSON object; Debian's Python runs this file."""

import importlib
import json
import random
import sys
from io import BytesIO
from typing import Any

import genpy  # type: ignore[import-not-found]  # Debian's Python has it

PACKAGES = sys.argv[1:]
RANGES = {
    "bool": (0, 1),
    "byte": (-128, 127),
    "char": (0, 255),
    **{f"int{bits}": (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)},
}
chance = random.Random(1)  # noqa: S311 - the same examples at every run


def example(notation: str) -> tuple[Any, Any]:
    base, _, size = notation.partition("[")
    if size:
        pairs = [example(base) for _ in range(int(size[:-1]) if size != "]" else chance.randrange(4))]
        values = [value for value, _ in pairs]
        return bytes(values) if base in ("uint8", "char") else values, [shown for _, shown in pairs]
    if base in RANGES:
        number = chance.randint(*RANGES[base])
        return (bool(number), bool(number)) if base == "bool" else (number, number)
    if base.startswith("float"):
        quarters = chance.randrange(-1000, 1000) / 4
        return quarters, quarters
    if base == "string":
        text = chance.choice(["", "a", "camera_frame", "\u00e9"])
        return text, text
    if base in ("time", "duration"):
        pair = [chance.randrange(1 << 31), chance.randrange(10**9)]
        return (genpy.Time if base == "time" else genpy.Duration)(*pair), pair
    return message(genpy.message.get_message_class(base))


def message(cls: Any) -> tuple[Any, dict[str, Any]]:
    pairs = [example(notation) for notation in cls._slot_types]
    shown = {name: pair[1] for name, pair in zip(cls.__slots__, pairs, strict=True)}
    return cls(*(pair[0] for pair in pairs)), shown


result = {}
for package in PACKAGES:
    for kind in ("msg", "srv"):
        try:
            module = importlib.import_module(f"{package}.{kind}")
        except ImportError:
            continue
        cls: Any
        for cls in vars(module).values():
            if not hasattr(cls, "_md5sum"):
                continue
            entry: dict[str, Any] = {"kind": kind, "md5sum": cls._md5sum}
            if hasattr(cls, "_request_class"):
                entry["kind"] = "service"
            else:
                instance, shown = message(cls)
                out = BytesIO()
                instance.serialize(out)
                entry |= {"text": cls._full_text, "bytes": out.getvalue().hex(), "values": shown}
            result[cls._type] = entry
json.dump(result, sys.stdout)
