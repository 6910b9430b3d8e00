"""All dependencies of the program exist for arm64 (Jetson, Raspberry Pi), though none of it runs here."""

import re
from pathlib import Path

import pytest

from distribution.checkout import ROOT
from distribution.environment import ARCHITECTURES, INTERPRETERS, make_environment
from distribution.extension import build
from tests.support.requirements import need_program

EM_AARCH64 = 183
pytestmark = pytest.mark.timeout(900)


def test_the_compiled_module_is_built_for_arm64() -> None:
    need_program("aarch64-linux-gnu-gcc", "gcc-aarch64-linux-gnu")
    made = build(ARCHITECTURES["arm64"].triplet).read_bytes()
    assert int.from_bytes(made[18:20], "little") == EM_AARCH64
    assert b"PyInit_pump" in made


def test_every_locked_package_exists_for_arm64(tmp_path: Path) -> None:
    need_program("aarch64-linux-gnu-gcc", "gcc-aarch64-linux-gnu")
    work = tmp_path / "work"
    work.mkdir()
    make_environment(tmp_path / "tree", ARCHITECTURES["arm64"], work)
    libraries = [path for path in (tmp_path / "tree").rglob("*.so*") if path.is_file()]
    assert len(libraries) > 20
    assert {int.from_bytes(path.read_bytes()[18:20], "little") for path in libraries} == {EM_AARCH64}
    for version in INTERPRETERS:
        tag = f"cpython-{version.replace('.', '')}-aarch64-linux-gnu"
        assert list((tmp_path / "tree" / f"lib/python{version}/site-packages").glob(f"libxtwrapper.{tag}.so"))
    listed = re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    folders = (tmp_path / "tree").rglob("*.dist-info")
    there = {
        re.sub(r"[_.]", "-", path.name.removesuffix(".dist-info").rpartition("-")[0].lower())
        for path in folders
    }
    assert set(listed) == there
