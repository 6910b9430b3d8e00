"""Tests of `rosrv monitor load`: what is sent to the appliance, and what is refused before."""

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.channel.admin import AdminAnswer, encode
from appliance.channel.answers.monitor_answers import Monitors, MonitorState, Replaced
from appliance.cli.main import app
from tests.support.answers import example

GOOD = "a() {\n  event e(int x) /t pkg/T '{data:x}' { }\n}\n"
REPLACED = example(Replaced, revision=2, replaced=1, added=["a.rv"])
LISTED = example(Monitors)


@pytest.fixture
def state(tmp_path: Path) -> Iterator[Path]:
    """A state directory at which an appliance answers; what it was asked is in `asked.json`."""
    folder = tmp_path / "state"
    folder.mkdir()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(folder / "admin.sock"))
    listener.listen()

    def serve() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            with peer, peer.makefile("rb") as lines:
                request = lines.readline()
                with (folder / "asked.json").open("ab") as asked:
                    asked.write(request)
                body = LISTED if b'"verb":"monitors"' in request else REPLACED
                peer.sendall(encode(AdminAnswer(True, body)) + b"\n")

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield folder
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(30)


def write(path: Path, text: str | bytes) -> Path:
    """A file, with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.fixture
def close(tmp_path: Path) -> Path:
    """A state directory at which an appliance answers once, with a monitor that came close."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(tmp_path / "admin.sock"))
    listener.listen()
    nearest = {"time": 5.0, "left": -0.475, "right": -0.45, "distance": 0.025, "threshold_at": -0.475}
    margin = {"line": 8, "column": 35, "condition": "if (P > -0.45) {", "since_load": nearest}
    rows = [
        example(MonitorState, name="gun", file="a.rv", margins=[margin]),
        example(MonitorState, name="other"),
    ]

    def serve() -> None:
        with listener, listener.accept()[0] as peer, peer.makefile("rb") as lines:
            lines.readline()
            peer.sendall(encode(AdminAnswer(True, example(Monitors, monitors=rows))) + b"\n")

    threading.Thread(target=serve, daemon=True).start()
    return tmp_path


@pytest.mark.parametrize("names", [(), ("gun",)])
def test_how_close_a_condition_came_is_a_row(close: Path, names: tuple[str, ...]) -> None:
    """Today, since the load, and where the constant would have to stand."""
    shown = CliRunner().invoke(app, ["monitor", "margins", *names, "--state", str(close)])
    assert shown.exit_code == 0
    row = shown.output.splitlines()[1].split()
    assert row == ["gun", "a.rv:8", "if", "(P", ">", "-0.45)", "{", "false", "-", "0.025", "-0.475"]


def test_margins_for_a_script_and_of_none(close: Path) -> None:
    """One object each; a monitor that there is not is named."""
    shown = CliRunner().invoke(app, ["monitor", "margins", "--json", "--state", str(close)])
    (found,) = map(json.loads, shown.output.splitlines())
    assert (found["monitor"], found["since_load"]["threshold_at"], found["today"]) == ("gun", -0.475, None)


def test_margins_of_a_monitor_that_there_is_not(close: Path) -> None:
    """Exit status 2."""
    shown = CliRunner().invoke(app, ["monitor", "margins", "gnu", "--state", str(close)])
    assert (shown.exit_code, "no monitor is called gnu" in shown.output) == (2, True)


def load(state: Path, *arguments: object) -> tuple[int, str]:
    """Exit status, and everything that was said."""
    done = CliRunner().invoke(app, ["monitor", "load", *map(str, arguments), "--state", str(state)])
    assert not isinstance(done.exception, Exception) or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def asked(state: Path) -> list[dict[str, Any]]:
    """What the appliance was asked."""
    file = state / "asked.json"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def test_files_of_one_name_are_refused(state: Path, tmp_path: Path) -> None:
    """Both are named, nothing is sent, exit status 2; one file that is named twice is one."""
    one, other = (write(tmp_path / zone / "safety.rv", GOOD) for zone in ("zone1", "zone2"))
    status, said = load(state, one, other)
    assert status == 2
    assert f"{one} and {other} have one name" in said
    assert asked(state) == []
    assert load(state, one, one, "--json")[0] == 0
    assert list(asked(state)[0]["files"]) == ["safety.rv"]


def test_a_folder_that_is_none_is_refused(state: Path, tmp_path: Path) -> None:
    """As by `check`: exit status 2, with its name."""
    file = write(tmp_path / "a.rv", GOOD)
    status, said = load(state, file, "--msg", tmp_path / "nowhere")
    assert status == 2
    assert "--msg: " in said
    assert "is no folder" in said
    assert asked(state) == []


def test_a_definition_without_a_package_is_refused(state: Path, tmp_path: Path) -> None:
    """As by `check`: exit status 1, and where it belongs; it is not taken for one of the folder's name."""
    file = write(tmp_path / "a.rv", GOOD)
    write(tmp_path / "msg" / "T.msg", "int32 data\n")
    status, said = load(state, file)
    assert status == 1
    assert "T.msg:1:1: error: a definition belongs into the folder of its package" in said
    assert CliRunner().invoke(app, ["monitor", "check", str(file)]).exit_code == 1
    status, said = load(state, file, "--json")
    assert status == 1
    assert "folder of its package" in json.loads(said)["findings"][0]
    assert asked(state) == []


def test_definitions_with_old_comments_are_sent(state: Path, tmp_path: Path) -> None:
    """A comment in another encoding means nothing, here as in `check`; a field or a constant in one is refused."""
    file = write(tmp_path / "a.rv", GOOD)
    definition = write(tmp_path / "msg" / "pkg" / "T.msg", b"# caf\xe9\nint32 data # na\xefve\n")
    assert load(state, file, "--json")[0] == 0
    sent = asked(state)[0]["definitions"]
    assert sent == {
        "pkg/T.msg": "# caf\N{REPLACEMENT CHARACTER}\nint32 data # na\N{REPLACEMENT CHARACTER}ve\n"
    }
    write(definition, b"int32 data\nstring NAME=# caf\xe9\n")
    status, said = load(state, file)
    assert status == 1
    assert "T.msg:2:1: error: these bytes are no UTF-8" in said


def test_a_specification_that_is_no_text_has_its_place(state: Path, tmp_path: Path) -> None:
    """Line and column of the bytes, as `check` gives them."""
    file = write(tmp_path / "a.rv", GOOD.encode() + b"// \xff\n")
    status, said = load(state, file)
    assert status == 1
    assert "a.rv:4:4: error: these bytes are no UTF-8" in said
