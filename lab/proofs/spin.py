import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from tests.support.requirements import need_program

_PROOFS = Path(__file__).parent
_MEGABYTES = 2000
_DEPTH = 1_000_000
_STEPS = 200  # of a trace in an inline, whose text Spin limits to 64 KB


@dataclass(frozen=True, slots=True)
class Model:
    path: Path
    properties: Mapping[str, str]


INSERTION = Model(
    _PROOFS / "insertion.pml",
    {"barred": "barred", "judge": "judged", "last": "whole", "published": "connected", "1": "accepted"},
)
LEASE = Model(
    _PROOFS / "lease.pml",
    {
        "admits": "fenced",
        "whole": "whole",
        "leads": "single",
        "epoch": "growing",
        "up": "served",
        "1": "accepted",
    },
)
FOLLOWER = Model(
    _PROOFS / "follower.pml",
    {"holder": "fenced", "learnt": "newest", "admitted": "shut", "since": "kept"},
)


class ModelBounds(Protocol):
    @property
    def model(self) -> Model: ...

    @property
    def defines(self) -> list[str]: ...


@dataclass(frozen=True, slots=True)
class LeaseBounds:
    grants: int
    last_fault: bool = False

    def __str__(self) -> str:
        return f"{self.grants}-grants" + "-last-fault" * self.last_fault

    @property
    def model(self) -> Model:
        return LEASE

    @property
    def defines(self) -> list[str]:
        return [f"-DGRANTS={self.grants}"] + ["-DLAST_FAULT"] * self.last_fault


@dataclass(frozen=True, slots=True)
class FollowerBounds:
    """The ticks that a lease lasts and a write of rules takes at most."""

    expiry: int
    write: int
    served: bool = False

    def __str__(self) -> str:
        return f"{self.expiry}-ticks-{self.write}-a-write" + "-served" * self.served

    @property
    def model(self) -> Model:
        return FOLLOWER

    @property
    def defines(self) -> list[str]:
        return [f"-DEXPIRY={self.expiry}", f"-DWRITE={self.write}"] + ["-DSERVED"] * self.served


@dataclass(frozen=True, slots=True)
class Bounds:
    """The bounds of the insertion's model. `sending` lets publishers send forever.

    With `refusing`, there are specifications that the relay cannot take.
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
    def model(self) -> Model:
        return INSERTION

    @property
    def defines(self) -> list[str]:
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
    broken: str
    states: int


def search(
    folder: Path, bounds: ModelBounds, mutant: str = "", traced: Path | None = None, *, large: bool = False
) -> Found:
    """Search all states, with `folder` for the files. `traced` is a copy of the model with a trace.

    Fail when the states do not fit into memory. With `large`, the checker is optimized, which takes four seconds.
    """
    spin, compiler = need_program("spin", "spin"), need_program("gcc", "g++")
    wrong = [f"-DMUTANT_{mutant}"] if mutant else []
    _run(folder, spin, "-a", *bounds.defines, *wrong, str(traced or bounds.model.path))
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
        return Found(bounds.model.properties.get(broken[1], broken[0]), int(states[1]))
    assert "errors: 0" in said, said
    assert "not completed" not in said, said
    assert "too small" not in said, said
    return Found("", int(states[1]))


Step = tuple[str, int, int]


def accepts(folder: Path, bounds: ModelBounds, trace: Sequence[Step]) -> bool:
    steps = [
        f"    kind[{place}] = {what}; first[{place}] = {one}; second[{place}] = {other};\n"
        for place, (what, one, other) in enumerate(trace)
    ]
    parts = ["".join(steps[start : start + _STEPS]) for start in range(0, len(steps), _STEPS)]
    inlines = [f"inline fill_{number}() {{\n{part}}}\n" for number, part in enumerate(parts)]
    filled = "; ".join(["skip", *(f"fill_{number}()" for number in range(len(parts)))])
    traced = folder / "traced.pml"
    head = f"#define TRACE\n#define LENGTH {len(trace)}\n"
    traced.write_text(
        f"{head}{bounds.model.path.read_text()}\n".replace(
            "init {", f"{''.join(inlines)}inline fill_trace() {{ {filled} }}\n\ninit {{"
        )
    )
    found = search(folder, bounds, traced=traced).broken
    assert found in ("", "accepted"), found
    return bool(found)


def _run(folder: Path, *command: str) -> str:
    ran = subprocess.run(command, cwd=folder, check=False, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout
