from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
KERNEL_FILE = ROOT / "distribution" / "kernel.txt"
OUTSIDE = "modules outside of it that the kernel may import"
LANGUAGE_TESTS = ROOT / "rosmop" / "tests"


def files_of_tests() -> Iterator[Path]:
    for folder in (ROOT / "tests", LANGUAGE_TESTS, ROOT / "fleet" / "tests", ROOT / "lab"):
        yield from sorted(folder.rglob("*.py"))


def kernel_parts() -> dict[str, list[str]]:
    """Return the sections of `kernel.txt`: the modules of each part, as paths below `appliance`."""
    parts: dict[str, list[str]] = {}
    for line in KERNEL_FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            parts[line.strip("[]")] = modules = []
        elif line and not line.startswith("#"):
            modules.append(line)
    return parts


def kernel_modules() -> list[str]:
    return [module for part, modules in kernel_parts().items() if part != OUTSIDE for module in modules]
