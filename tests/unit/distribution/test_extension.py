import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from distribution.checkout import ROOT
from distribution.extension import IN_PLACE, SOURCE

pytestmark = pytest.mark.nightly

_TEXT = '''"""A small module."""

from libc.string cimport memcpy


def answer(unsigned char[::1] place):
    """Return the last byte of four."""
    cdef unsigned char[4] mine
    memcpy(mine, &place[0], len(place))
    return mine[3] + {}
'''


class Checkout:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.source = folder / SOURCE
        self.made = folder / IN_PLACE.relative_to(ROOT)
        self.source.parent.mkdir(parents=True)
        self.program = folder / "distribution/extension.py"
        self.program.parent.mkdir()
        shutil.copyfile(ROOT / "distribution/extension.py", self.program)
        self.write(_TEXT.format(1))

    def write(self, text: str) -> None:
        self.source.write_text(text)

    def start(self, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, str(self.program)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def build(self, path: str = "/usr/bin:/bin") -> tuple[int, str]:
        process = self.start(PATH=path)
        output, errors = process.communicate(timeout=120)
        return process.returncode, output + errors

    def answer(self) -> int:
        code = "import pump; print(pump.answer(bytearray(b'abcd')) - ord('d'))"
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, cwd=self.made.parent, capture_output=True, text=True, check=True)
        return int(done.stdout)


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path / "one")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    made = Checkout(tmp_path_factory.mktemp("original") / "with a longer name")
    assert made.build() == BUILT
    return made


@pytest.fixture
def built(original: Checkout, checkout: Checkout) -> Checkout:
    shutil.copytree(original.folder, checkout.folder, dirs_exist_ok=True)
    return checkout


BUILT = (0, f"extension: built {IN_PLACE.relative_to(ROOT)}\n")


def test_it_is_built_when_something_changed(built: Checkout) -> None:
    before = built.made.stat()
    assert built.answer() == 1
    assert built.build() == (0, "")
    after = built.made.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    built.write(_TEXT.format(2))
    assert (built.build(), built.answer()) == (BUILT, 2)


def test_the_module_compiles_without_a_warning(checkout: Checkout) -> None:
    checkout.write((ROOT / SOURCE).read_text())
    assert checkout.build() == BUILT


def test_a_lost_or_damaged_file_is_replaced(built: Checkout) -> None:
    whole = built.made.read_bytes()
    built.made.write_bytes(whole[:100])
    assert (built.build(), built.made.read_bytes()) == (BUILT, whole)
    built.made.unlink()
    assert (built.build(), built.made.read_bytes()) == (BUILT, whole)


def test_a_wrong_source_leaves_the_last_module(built: Checkout) -> None:
    built.write("def answer(:\n")
    for _ in range(2):
        status, output = built.build()
        assert (status, built.answer()) == (1, 1)
        assert f"{SOURCE}:1:11" in output
        assert re.search(
            rf"^extension: {SOURCE}: this command ended with status 1: \S+ -m cython", output, re.M
        )


def test_a_missing_compiler_is_named(checkout: Checkout, tmp_path: Path) -> None:
    status, output = checkout.build(path=str(tmp_path))
    assert status == 1
    assert output.startswith("extension: gcc or ")
    assert output.endswith("is missing: sudo apt-get install gcc libc6-dev python3-dev\n")


def test_many_builds_at_once(checkout: Checkout) -> None:
    several = [checkout.start(PATH="/usr/bin:/bin") for _ in range(6)]
    said = {process.communicate(timeout=120)[1] for process in several}
    assert said <= {BUILT[1], ""}
    assert {process.returncode for process in several} == {0}
    assert checkout.answer() == 1


def test_two_folders_have_the_same_module(checkout: Checkout, original: Checkout) -> None:
    assert checkout.build() == BUILT
    assert checkout.made.read_bytes() == original.made.read_bytes()
    assert str(checkout.folder).encode() not in checkout.made.read_bytes()


def test_it_is_hardened(original: Checkout) -> None:
    """The addresses of functions are read-only after loading, and a buffer overflow ends the process."""
    shown = subprocess.run(
        ["readelf", "--wide", "--dynamic", "--program-headers", "--symbols", str(original.made)],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert all(word in shown for word in ("BIND_NOW", "GNU_RELRO", "__stack_chk_fail", "__memcpy_chk"))
    assert re.search(r"GNU_STACK.* RW ", shown)
    process = subprocess.Popen(
        [sys.executable, "-c", "import pump; pump.answer(bytearray(5))"],
        cwd=original.made.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert b"buffer overflow detected" in process.communicate(timeout=60)[1]


def pins() -> Iterator[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    yield from project["build-system"]["requires"]
    yield from project["project"]["optional-dependencies"]["dev"]
    for name in ("requirements-bootstrap.in", "requirements-bootstrap.lock", "requirements-dev.lock"):
        yield from (line.removesuffix(" \\") for line in (ROOT / name).read_text().splitlines())


def test_all_builds_have_the_same_cython() -> None:
    found = [pin for pin in pins() if pin.startswith("cython==")]
    assert (len(found), len(set(found))) == (5, 1)
