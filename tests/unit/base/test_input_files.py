import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import pytest
import structlog

from appliance.base.input_files import read_given, read_given_text
from appliance.cli import main
from appliance.cli.connection.rest_session import _context
from tests.support.examples import sample

POLICY = "[Nodes]\ndefault = *\n"
SPECIFICATION = "m() { event e() /t std_msgs/Int32 '{}' {} fsm: s0 [ e -> s0 ] @s0 {} }\n"

# `{}` is the bad file; the other files are valid.
VERBS = [
    "policy check {}",
    "policy test {}",
    "policy test policy.ini --cases {}",
    "policy explain {} --host 10.0.0.9 --command getPid",
    "policy diff {} policy.ini --requests empty",
    "policy diff policy.ini policy.ini --requests {}",
    "monitor check {}",
    "monitor check m.rv --msg {}",
    "monitor run m.rv --bag {}",
    "monitor run {} --bag empty",
    "monitor learn --bag {}",
    "monitor coverage m.rv --bag {}",
    "monitor replay m.rv --bag {}",
    "sign {} --key policy.ini",
    "sign policy.ini --key {}",
    "config check {}",
    "up --config {}",
    "audit verify --key {}",
    "audit verify --checkpoints {}",
    "evidence verify {}",
    "evidence verify policy.ini --key {}",
    "evidence verify policy.ini --checkpoints {}",
    "restore {} --state new",
]


def folder(path: Path) -> None:
    (path / "p").mkdir(parents=True)
    os.mkfifo(path / "p" / "T.msg")


def huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 30)


KINDS: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda place: place.symlink_to("/dev/zero"),
    "folder": folder,
    "loop": lambda place: place.symlink_to(place),
    "empty": Path.touch,
    "bytes": lambda place: place.write_bytes(bytes(range(256)) * 10),
    "deep": lambda place: place.write_bytes(b"[" * 100_000),
    "huge": huge,
}


@pytest.fixture
def logs() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = [*root.handlers], root.level
    yield
    structlog.reset_defaults()
    structlog.contextvars.clear_contextvars()
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize(("verb", "kind"), sample(product(VERBS, KINDS), 3))
def test_no_file_makes_a_verb_hang_or_crash(
    verb: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROSRV_TOKEN", "x" * 43)
    Path("policy.ini").write_text(POLICY)
    Path("m.rv").write_text(SPECIFICATION)
    Path("empty").touch()
    KINDS[kind](Path("given"))
    monkeypatch.setattr(
        sys,
        "argv",
        ["rosrv", *verb.format("given").split(), "--state", "state"][: None if "audit" in verb else -2],
    )
    with pytest.raises(SystemExit) as ended:
        main.main()
    said = capsys.readouterr()
    assert ended.value.code in (0, 1, 2), said.err
    assert said.out + said.err
    if kind in ("pipe", "device", "loop"):
        assert ended.value.code != 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_bad_certificate_file_is_an_error(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    KINDS[kind](Path("given"))
    with pytest.raises(ValueError, match="--api-ca given: "):
        _context(Path("given"))


@pytest.mark.nightly
def test_a_pipe_of_the_shell_is_read(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from appliance.base import input_files;"
        " print(input_files.read_given(Path(sys.argv[1])))"
    )
    said = subprocess.run(
        ["bash", "-c", '"$0" -c "$1" <(printf a; printf b)', sys.executable, script],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    ).stdout  # fmt: skip
    assert said == "b'ab'\n"
    assert read_given(Path("/dev/null")) == b""


def test_files_are_bounded(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"abc\r\nd\n")
    assert read_given(file, 7) == b"abc\r\nd\n"
    assert read_given_text(file) == "abc\nd\n"
    with pytest.raises(OSError, match="longer than 6 bytes"):
        read_given(file, 6)
