import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.features.standby.replication import certificates, listening_socket, tables_of

pytestmark = pytest.mark.nightly


class Side:
    def __init__(self, name: str, directory: Path, descriptor: int, port: int) -> None:
        module = "tests.support.features.standby.replication_process"
        self._command = [sys.executable, "-m", module, name, str(directory), str(port), str(descriptor)]
        self._descriptor = descriptor
        self.process = self._start()

    def _start(self) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            text=True, pass_fds=[self._descriptor],
        )  # fmt: skip

    def kill(self) -> str:
        self.process.kill()
        assert self.process.stdin is not None
        self.process.stdin.close()
        assert self.process.stdout is not None
        rest = self.process.stdout.read()
        self.process.stdout.close()
        self.process.wait(30)
        return rest

    def start_again(self) -> None:
        self.process = self._start()

    def lines(self) -> Iterator[str]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            yield line.strip()


def marks_in(path: Path) -> set[int]:
    return {number for (number,) in tables_of(path)["mark"]}


@pytest.mark.parametrize("seed", range(3))
def test_no_acknowledged_change_is_lost_by_a_kill(tmp_path: Path, seed: int) -> None:
    chosen = random.Random(seed)  # noqa: S311  draws examples
    certificates(tmp_path)
    listening = listening_socket()
    port: int = listening.getsockname()[1]
    active = Side("active", tmp_path, listening.fileno(), port)
    standby = Side("standby", tmp_path, listening.fileno(), port)
    acknowledged: list[int] = []
    try:
        for _ in range(8):
            reading = chosen.randrange(1, 30)
            for line in active.lines():
                acknowledged.append(int(line))
                reading -= 1
                if not reading:
                    break
            killed = chosen.choice([[active], [standby], [active, standby]])
            for side in killed:
                rest = side.kill()
                acknowledged += map(int, rest.split()) if side is active else []
            assert marks_in(tmp_path / "standby.db") >= set(acknowledged)
            for side in killed:
                side.start_again()
        assert active.process.stdin is not None
        active.process.stdin.write("end\n")
        active.process.stdin.flush()
        assert "equal" in active.lines()
        assert tables_of(tmp_path / "standby.db") == tables_of(tmp_path / "active.db")
        assert marks_in(tmp_path / "active.db") >= set(acknowledged)
    finally:
        for side in (active, standby):
            if side.process.poll() is None:
                side.kill()
        listening.close()
    assert len(acknowledged) > 20
    assert len(set(acknowledged)) == len(acknowledged)
