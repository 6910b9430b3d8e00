import ast
import os
import sys
from pathlib import Path

import pytest

from appliance.channel.messages import Contents, ContentsFound, ContentsWanted, PartsMade, PartsWanted
from appliance.specifications import compiled_store
from appliance.specifications.compiled_store import LIBRARIES, SOURCES, CompiledStore, toolchain
from distribution.fact_cache import statements

QUESTION = ContentsWanted(0, {"a.rv": "text", "b.rv": "more"}, {}, at_start=True)
ANSWER = ContentsFound(7, Contents({"a": "a.rv"}, topics={"/t": frozenset({"a"})}, compiled=b"code"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "compiled"


def numbered(number: int) -> PartsWanted:
    return PartsWanted(0, b"%d" % number, [])


def test_an_answer_is_found_after_a_restart_by_its_whole_question(folder: Path) -> None:
    assert not CompiledStore(folder, "x")
    CompiledStore(folder, "x").keep(QUESTION, ANSWER)
    again = CompiledStore(folder, "x")
    assert again
    assert again.find(QUESTION, ContentsFound) == ANSWER
    reordered = ContentsWanted(0, {"b.rv": "more", "a.rv": "text"}, {}, at_start=True)
    assert again.find(reordered, ContentsFound) == ANSWER
    for other in ({"a.rv": "text"}, {"a.rv": "text", "b.rv": "other"}):
        assert again.find(ContentsWanted(0, other, {}, at_start=True), ContentsFound) is None
    assert (folder.stat().st_mode & 0o777, next(folder.iterdir()).stat().st_mode & 0o777) == (0o700, 0o600)


def test_another_compiler_or_processor_does_not_get_it(folder: Path) -> None:
    CompiledStore(folder, "x").keep(QUESTION, ANSWER)
    assert CompiledStore(folder, "y").find(QUESTION, ContentsFound) is None


def test_the_digest_of_the_toolchain_depends_on_the_processor(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("one", "same", "other")]
    files[0].write_text("flags\t\t: fpu sse2\nbogomips\t: 1\n\nflags\t\t: fpu sse2\n")
    files[1].write_text("flags\t\t: fpu sse2\nbogomips\t: 2\n")
    files[2].write_text("flags\t\t: fpu sse2 avx\n")
    one, same, other = map(toolchain, files)
    assert one == same != other
    assert toolchain(tmp_path / "unreadable") == ""


def test_the_digest_of_the_toolchain_covers_all_that_the_compiler_imports() -> None:
    root = Path(compiled_store.__file__).parents[2]
    folders = {path.parent.name for path in root.glob("*/__init__.py")}
    used, found = set[str](), set[str]()
    waiting = ["appliance.compiler.process"]
    while waiting:
        name = waiting.pop()
        file = next(
            (
                one
                for one in (
                    root / f"{name.replace('.', '/')}.py",
                    root / name.replace(".", "/") / "__init__.py",
                )
                if one.is_file()
            ),
            None,
        )
        if name in found or file is None:
            continue
        found.add(name)
        for node in statements(ast.parse(file.read_bytes())):
            names = [one.name for one in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{one}" for one in names)]
            used |= {one.partition(".")[0] for one in names}
            waiting += [one for one in names if one.partition(".")[0] in folders]
    assert used & folders == {*SOURCES}
    without_effect = {"rich", "cryptography"}  # the terminal, and signatures
    assert used - folders - set(sys.stdlib_module_names) - without_effect <= {*LIBRARIES}


def test_nothing_is_kept_with_an_unknown_toolchain(folder: Path) -> None:
    store = CompiledStore(folder, "")
    store.keep(QUESTION, ANSWER)
    assert not folder.exists()
    assert store.find(QUESTION, ContentsFound) is None


@pytest.mark.parametrize(
    "damage", [b"", b"x", lambda data: data[:-1], lambda data: data[:40] + b"?" + data[41:]]
)
def test_a_damaged_file_is_deleted(folder: Path, damage: object) -> None:
    store = CompiledStore(folder, "x")
    store.keep(QUESTION, ANSWER)
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()) if callable(damage) else damage)  # type: ignore[arg-type]  # bytes
    assert store.find(QUESTION, ContentsFound) is None
    assert not file.exists()


def test_an_answer_of_another_kind_is_not_taken(folder: Path) -> None:
    store = CompiledStore(folder, "x")
    store.keep(QUESTION, PartsMade(0, []))
    assert store.find(QUESTION, ContentsFound) is None


def test_their_number_and_size_are_bounded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = CompiledStore(folder, "x")
    for number in range(20):
        store.keep(numbered(number), PartsMade(0, [b"part"]))
        for path in folder.iterdir():  # the files of one test would have the same time
            os.utime(path, ns=(path.stat().st_mtime_ns - 10**9,) * 2)
        store.find(numbered(0), PartsMade)  # in use
    kept = [number for number in range(20) if store.find(numbered(number), PartsMade)]
    assert kept == [0, *range(13, 20)]
    monkeypatch.setattr(compiled_store, "_MAX_BYTES", 1000)
    store.keep(numbered(20), PartsMade(0, [bytes(400)]))
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 1000
    store.keep(numbered(21), PartsMade(0, [bytes(600)]))
    assert store.find(numbered(21), PartsMade) is None


def test_a_full_disk_keeps_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = CompiledStore(folder, "x")
    full = os.statvfs_result((4096, 4096, 1000, 100, 100, 1000, 100, 100, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda _path: full)
    store.keep(QUESTION, ANSWER)
    assert list(folder.iterdir()) == []
    monkeypatch.undo()

    def fails(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled_store, "write_whole", fails)
    store.keep(QUESTION, ANSWER)
    assert store.find(QUESTION, ContentsFound) is None
