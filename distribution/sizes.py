"""Print the sizes of the program's parts, and of each module of the kernel: `python -m distribution.sizes`.

The last two lines count the words of the guides (`docs/*.md`) and of all pages.

With `--release`, which `make release` uses, the exit status is 1 if a part exceeds its limit by more than 5 %. Between
releases nothing depends on these numbers: `distribution/interfaces.py` counts what a change should not add to.
"""

import sys
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from distribution.checkout import ROOT

KERNEL_FILE = Path(__file__).with_name("kernel.txt")
OUTSIDE = "modules outside of it that the kernel may import"
_PLAY = 1.05
# Lines of Python, with blank lines, comments and docstrings; of the kernel, lines of code. Set again at each release.
LIMITS = {"core": 68_660, "features": 50_620, "language": 45_680, "tests": 161_220, "kernel": 12_005}
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip


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


def lines_of_code(path: Path) -> int:
    """Count the lines of a module without blank lines, comments and docstrings."""
    lines: set[int] = set()
    statement: list[tokenize.TokenInfo] = []
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type not in _NO_CODE and token.type != tokenize.ENCODING:
                statement.append(token)
            elif token.type == tokenize.NEWLINE:
                if [part.type for part in statement] != [tokenize.STRING]:
                    for part in statement:
                        lines.update(range(part.start[0], part.end[0] + 1))
                statement = []
    return len(lines)


def sizes() -> Mapping[str, int]:
    """Return the size of each part in `LIMITS`."""
    appliance, features = _lines_in("appliance"), _lines_in("appliance/features")
    language_tests = _lines_in("rosmop/tests")
    return {
        "core": appliance - features,
        "features": features,
        "language": _lines_in("rosmop") + _lines_in("roswire") - language_tests,
        "tests": _lines_in("tests") + _lines_in("lab") + language_tests,
        "kernel": sum(lines_of_code(ROOT / "appliance" / module) for module in kernel_modules()),
    }


def words() -> Mapping[str, int]:
    """Return the words of the guides, which a user reads, and of all pages."""
    docs = ROOT / "docs"
    return {"guides": _words_in(docs.glob("*.md")), "pages": _words_in(docs.rglob("*.md"))}


def too_large(measured: Mapping[str, int]) -> list[str]:
    """Return a line for each part that exceeds its limit by more than 5 %."""
    return [
        f"{part} has {size:,} lines, and a limit of {LIMITS[part]:,}: remove code, or set the limit in {__spec__.name}"
        for part, size in measured.items()
        if size > LIMITS[part] * _PLAY
    ]


def _lines_in(folder: str) -> int:
    return sum(path.read_bytes().count(b"\n") for path in (ROOT / folder).rglob("*.py"))


def _words_in(files: Iterable[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").split()) for path in files)


def _report(measured: Mapping[str, int]) -> Iterator[str]:
    for part, size in measured.items():
        yield f"{part:<10}{size:>9,}  of {LIMITS[part]:,}"
    for part, modules in kernel_parts().items():
        if part != OUTSIDE:
            yield f"\n{part}"
            yield from (f"{lines_of_code(ROOT / 'appliance' / module):>6}  {module}" for module in modules)
    yield "\nwords"
    yield from (f"{part:<10}{number:>9,}" for part, number in words().items())


def main(arguments: list[str]) -> int:
    if arguments not in ([], ["--release"]):
        sys.stderr.write("sizes: the only option is --release\n")
        return 2
    measured = sizes()
    if not arguments:
        sys.stdout.write("\n".join(_report(measured)) + "\n")
        return 0
    lines = too_large(measured)
    sys.stderr.write("".join(f"sizes: {line}\n" for line in lines))
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
