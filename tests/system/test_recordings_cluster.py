"""Many recordings on a Ray cluster: the report of one process, also if a node of the cluster is killed."""

import os
import secrets
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

from rosmop.tests.batch.test_many_recordings import SPECIFICATION, make_bag
from rosmop.tool.batch_session import SOME_FAILED
from tests.support.requirements import needs
from tests.support.waiting import eventually

BIN = Path(sys.executable).parent
PORT, CLIENTS, AGENT = 26379, 26380, 26381
PATIENCE = 60


@dataclass
class Cluster:
    """Nodes on this machine, with one processor each. Their processes have a mark in their environment."""

    folder: Path
    mark: str = field(default_factory=lambda: secrets.token_hex(8))
    token: str = field(default_factory=lambda: secrets.token_hex(32))

    def environment(self, node: int | None = None) -> dict[str, str]:
        """Return the environment of a node's processes, or of a command."""
        own = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": self.token, "RAY_USAGE_STATS_ENABLED": "0"}
        own["RAY_health_check_period_ms"] = "500"  # a dead node is noticed after five checks
        own |= {"PATH": f"{BIN}:{os.environ['PATH']}", "RAY_ADDRESS": f"127.0.0.1:{PORT}"}
        if node is None:
            return os.environ | own
        del own["RAY_ADDRESS"]
        return os.environ | own | {"TEST_NODE": f"{self.mark}.{node}"}

    def start(self, node: int) -> None:
        """Start a node; 0 is the head."""
        head = [
            "--head", f"--port={PORT}", f"--ray-client-server-port={CLIENTS}", "--include-dashboard=false",
            f"--runtime-env-agent-port={AGENT}", f"--temp-dir={self.folder}",
        ]  # fmt: skip
        command = [
            str(BIN / "ray"),
            "start",
            "--num-cpus=1",
            "--disable-usage-stats",
            "--node-ip-address=127.0.0.1",
        ]
        command += head if node == 0 else [f"--address=127.0.0.1:{PORT}"]
        done = subprocess.run(
            command, env=self.environment(node), capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def kill(self, node: str = "") -> int:
        """Kill the processes of a node, or of all; return their number."""
        mark = f"TEST_NODE={self.mark}.{node}".encode()
        count = 0
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if any(text.startswith(mark) for text in (process / "environ").read_bytes().split(b"\0")):
                    os.kill(int(process.name), signal.SIGKILL)
                    count += 1
        return count

    def start_rosrv(self, *words: str, **environment: str) -> "subprocess.Popen[str]":
        """Start a command on the cluster."""
        return subprocess.Popen(
            [BIN / "rosrv", "monitor", *words], env=self.environment() | environment, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def rosrv(self, *words: str, **environment: str) -> tuple[int, str, str]:
        """Run a command on the cluster; return the exit status and the output."""
        with self.start_rosrv(*words, **environment) as process:
            out, err = process.communicate(timeout=PATIENCE)
        return process.returncode, out, err


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Return a cluster with its head. Its folder has a short name, because its sockets have long ones."""
    needs(find_spec("ray"), "Ray: pip install 'rosmop[ray]'")
    with tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp") as folder:
        cluster = Cluster(Path(folder))
        try:
            cluster.start(0)
            yield cluster
        finally:
            cluster.kill()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with recordings, and the report of one process and of two, which are equal."""
    folder = tmp_path_factory.mktemp("recordings")
    (folder / "limit.rv").write_text(SPECIFICATION)
    (folder / "bags").mkdir()
    for seed in range(12):
        make_bag(folder / "bags" / f"{seed}.bag", seed, 1500)
    (folder / "bags/broken.bag").write_text("nonsense")
    for workers in ("1", "2"):
        words = ["run", "limit.rv", "--bags", "bags", "--report", workers, "--workers", workers]
        done = subprocess.run(
            [BIN / "rosrv", "monitor", *words], cwd=folder, capture_output=True, check=False
        )
        assert done.returncode == SOME_FAILED
    assert (folder / "1").read_bytes() == (folder / "2").read_bytes()
    return folder


@pytest.fixture
def expected(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Make the recordings' folder the current one, and return the report of one process."""
    monkeypatch.chdir(recordings)
    return Path("1").read_bytes()


def test_a_node_gives_the_report_of_a_process(cluster: Cluster, expected: bytes, tmp_path: Path) -> None:
    """A client from outside, and learning on the node, have the results of a process."""
    report, words = tmp_path / "report", ("--bags", "bags", "--on")
    status, _out, err = cluster.rosrv(
        "run", "limit.rv", *words, f"ray://127.0.0.1:{CLIENTS}", "--report", str(report)
    )
    assert status == SOME_FAILED, err
    assert report.read_bytes() == expected
    here, there = tmp_path / "here.rv", tmp_path / "there.rv"
    assert cluster.rosrv("learn", "--bags", "bags", "--out", str(here))[0] == SOME_FAILED
    assert cluster.rosrv("learn", *words, "auto", "--out", str(there))[0] == SOME_FAILED
    assert here.read_bytes() == there.read_bytes()


def test_a_wrong_token_is_refused(cluster: Cluster, expected: bytes) -> None:
    """The cluster executes nothing for a command without its token."""
    words = ("run", "limit.rv", "--bags", "bags", "--on", "auto")
    status, out, err = cluster.rosrv(*words, RAY_AUTH_TOKEN=secrets.token_hex(32))
    assert (status, out) == (2, "")
    assert "cannot use the cluster" in err


def test_a_node_that_is_killed_changes_nothing(cluster: Cluster, expected: bytes, tmp_path: Path) -> None:
    """Three nodes, of which one is killed while it works, give the same report."""
    cluster.start(1)
    cluster.start(2)
    journal, report = tmp_path / "journal", tmp_path / "report"
    words = (
        "run",
        "limit.rv",
        "--bags",
        "bags",
        "--on",
        "auto",
        "--report",
        str(report),
        "--resume",
        str(journal),
    )
    with cluster.start_rosrv(*words) as command:
        eventually(
            lambda: journal.exists() and journal.read_bytes().count(b"\n") >= 1, "a recording is finished"
        )
        assert command.poll() is None
        assert cluster.kill("2") > 1
        _out, err = command.communicate(timeout=PATIENCE)
    assert command.returncode == SOME_FAILED, err
    assert report.read_bytes() == expected
