"""Spin on `proofs/insertion.pml`: bounds, mutants, and what an exhaustive search finds."""

import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.requirements import need_program

MODEL = Path(__file__).parents[2] / "proofs" / "insertion.pml"

_MEGABYTES = 2000
_DEPTH = 1_000_000
_PROPERTIES = {
    "barred": "barred",
    "judge": "judged",
    "last": "whole",
    "published": "connected",
    "1": "accepted",
}
"""The first name in an assertion, and what the head of the model calls the property."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """How many nodes there are, and how often what happens; `sending`: publishers send, for ever.

    `refusing`: there are specifications that the relay cannot take.
    """

    publishers: int = 1
    subscribers: int = 1
    loads: int = 0
    policies: int = 0
    crashes: int = 0
    sending: bool = True
    refusing: bool = False

    def __str__(self) -> str:
        numbers = (self.publishers, self.subscribers, self.loads, self.policies, self.crashes)
        words = ("publishers", "subscribers", "loads", "policies", "crashes")
        said = [f"{number}-{word}" for number, word in zip(numbers, words, strict=True) if number]
        return "-".join([*said, *["refusing"] * self.refusing, *["at-rest"] * (not self.sending)])

    @property
    def defined(self) -> list[str]:
        """As the model is told."""
        numbers = {
            "PUBLISHERS": self.publishers,
            "SUBSCRIBERS": self.subscribers,
            "LOADS": self.loads,
            "POLICIES": self.policies,
            "CRASHES": self.crashes,
            "SENDING": "true" if self.sending else "false",
        }
        return [f"-D{name}={value}" for name, value in numbers.items()] + ["-DREFUSING"] * self.refusing


@dataclass(frozen=True, slots=True)
class Found:
    """What a search found: the property that is broken (empty: none is), and how many states there are."""

    broken: str
    states: int


def search(
    folder: Path, bounds: Bounds, mutant: str = "", model: Path = MODEL, *, large: bool = False
) -> Found:
    """Look at every state that the model can reach, in `folder`. Fails when they are more than fit into memory.

    `large`: so many that a program that is fast is worth the time that it takes to be made (four seconds).
    """
    spin, compiler = need_program("spin", "spin"), need_program("gcc", "g++")
    wrong = [f"-DMUTANT_{mutant}"] if mutant else []
    _run(folder, spin, "-a", *bounds.defined, *wrong, str(model))
    _run(
        folder,
        compiler,
        "-O1" if large else "-O0",
        "-w",
        "-DSAFETY",
        "-DCOLLAPSE",
        f"-DMEMLIM={_MEGABYTES}",
        "-o",
        "pan",
        "pan.c",
    )
    said = _run(folder, "./pan", "-E", f"-m{_DEPTH}")
    states = re.search(r"(\d+) states, stored", said)
    assert states is not None, said
    broken = re.search(r"pan:1: assertion violated \W*(\w+)", said)
    if broken is not None:
        return Found(_PROPERTIES.get(broken[1], broken[0]), int(states[1]))
    assert "errors: 0" in said, said
    assert "not completed" not in said, said
    assert "too small" not in said, said
    return Found("", int(states[1]))


Step = tuple[str, int, int]
"""Of a trace: what happened, and two numbers that it is about."""


def accepts(folder: Path, bounds: Bounds, trace: Sequence[Step]) -> bool:
    """Whether the model has a way that leaves this trace: all are tried."""
    filled = "".join(
        f"    kind[{place}] = {what}; first[{place}] = {one}; second[{place}] = {other};\n"
        for place, (what, one, other) in enumerate(trace)
    )
    model = folder / "traced.pml"
    head = f"#define TRACE\n#define LENGTH {len(trace)}\n"
    model.write_text(
        f"{head}{MODEL.read_text()}\n".replace("init {", f"inline fill_trace() {{\n{filled}}}\n\ninit {{")
    )
    found = search(folder, bounds, model=model).broken
    assert found in ("", "accepted"), found
    return bool(found)


def _run(folder: Path, *command: str) -> str:
    ran = subprocess.run(command, cwd=folder, check=False, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout
