import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rosmop.tool.command import app
from rosmop.tool.command_context import MAX_FILE

SPECIFICATION = "m() { event e() /t std_msgs/Empty '{}' {} }\n"


def huge(path: Path) -> None:
    path.touch()
    os.truncate(path, MAX_FILE + 1)


PIPE, DEVICE = "not a regular file: it is a named pipe", "not a regular file: it is a device"
FILES: list[tuple[str, Callable[[Path], object], str]] = [
    ("check given", os.mkfifo, PIPE),
    ("check given", lambda path: path.symlink_to("/dev/zero"), DEVICE),
    ("check given", Path.mkdir, "not a regular file: it is a folder"),
    ("check given", huge, f"longer than {MAX_FILE} bytes"),
    ("run m.rv given", lambda path: path.write_bytes(b"#ROSBAG V2.0\n"), "use --bag given"),
    ("check given", lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "given is a recording"),
    ("run m.rv --bag given", os.mkfifo, PIPE),
    ("run m.rv --bag given", lambda path: path.symlink_to("/dev/zero"), DEVICE),
    ("learn --bag given", os.mkfifo, PIPE),
    ("coverage m.rv --bag given", os.mkfifo, PIPE),
]


@pytest.mark.parametrize(("command", "make", "reason"), FILES)
def test_other_files_are_usage_errors(
    command: str, make: Callable[[Path], object], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.rv").write_text(SPECIFICATION)
    make(Path("given"))
    done = CliRunner().invoke(app, command.split())
    assert done.exit_code == 2
    assert reason in done.stderr


def test_an_unreadable_folder_of_definitions_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.rv").write_text(SPECIFICATION)
    Path("own/package").mkdir(parents=True)
    listed = os.scandir

    def refuse(path: str) -> object:
        if Path(path).name == "package":
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return listed(path)

    monkeypatch.setattr(os, "scandir", refuse)
    done = CliRunner().invoke(app, ["check", "m.rv", "--msg", "own"])
    assert done.exit_code == 2
    assert "cannot read the folder own/package: Permission denied" in done.stderr
