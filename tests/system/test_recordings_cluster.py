import contextlib
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

from rosmop.tests.batch.test_many_recordings import SPECIFICATION, make_bag
from rosmop.tool.batch_session import SOME_FAILED
from tests.support.own_namespace import own_loopback
from tests.support.requirements import need_root, needs
from tests.support.waiting import eventually

BIN = Path(sys.executable).parent
PORT, CLIENTS, AGENT = 26379, 26380, 26381
PATIENCE = 180
RECORDINGS = 50
MESSAGES = 1000  # so each command still works when a test kills a node
COMMANDS = ("run limit.rv", "learn", "coverage limit.rv", "replay limit.rv")


@dataclass
class Cluster:
    """Nodes on this machine with one processor each. Their processes have a mark in their environment."""

    folder: Path
    mark: str = field(default_factory=lambda: secrets.token_hex(8))
    token: str = field(default_factory=lambda: secrets.token_hex(32))

    def environment(self, node: int | None = None) -> dict[str, str]:
        own = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": self.token, "RAY_USAGE_STATS_ENABLED": "0"}
        own["RAY_health_check_period_ms"] = "500"  # a dead node is noticed after five checks
        own["RAY_worker_niceness"] = "0"  # Ray's own is 15, so that other tests would take the processors
        own["GRPC_ENABLE_FORK_SUPPORT"] = "0"  # as docs/reference/from-recordings.md says
        # Ray's own is 30 s. After it, the command still has time to say so.
        own["RAY_CLIENT_SERVER_CHECK_CHANNEL_TIMEOUT_S"] = str(PATIENCE // 2)
        own |= {"PATH": f"{BIN}:{os.environ['PATH']}", "RAY_ADDRESS": f"127.0.0.1:{PORT}"}
        if node is None:
            return os.environ | own
        del own["RAY_ADDRESS"]
        return os.environ | own | {"TEST_NODE": f"{self.mark}.{node}"}

    def start(self, node: int) -> None:
        head = [
            "--head", f"--port={PORT}", f"--ray-client-server-port={CLIENTS}", "--include-dashboard=false",
            f"--runtime-env-agent-port={AGENT}", f"--temp-dir={self.folder}",
        ]  # fmt: skip
        command = [
            str(BIN / "ray"), "start", "--num-cpus=1", "--object-store-memory=100000000", "--disable-usage-stats",
            "--node-ip-address=127.0.0.1",
        ]  # fmt: skip
        command += head if node == 0 else [f"--address=127.0.0.1:{PORT}"]
        done = subprocess.run(
            command, env=self.environment(node), capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def processes(self, node: str = "") -> list[int]:
        mark = f"TEST_NODE={self.mark}.{node}".encode()
        found, parents = set[int](), dict[int, int]()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
                if any(text.startswith(mark) for text in (process / "environ").read_bytes().split(b"\0")):
                    found.add(int(process.name))
        while more := {pid for pid, parent in parents.items() if parent in found} - found:
            found |= more
        return sorted(found)

    def kill(self, node: str = "") -> int:
        found = self.processes(node)
        for pid in found:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return len(found)

    def log(self) -> str:
        files = sorted(self.folder.glob("session_2*/logs/ray_client_server*"))
        return "".join(f"\n{file.name}:\n{file.read_text()}" for file in files)

    def start_rosrv(self, *words: str, **environment: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [BIN / "rosrv", "monitor", *words], env=self.environment() | environment, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def rosrv(self, *words: str, **environment: str) -> tuple[int, str, str]:
        with self.start_rosrv(*words, **environment) as process:
            out, err = process.communicate(timeout=PATIENCE)
        return process.returncode, out, err


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Yield a cluster on a private loopback, because some of its processes listen on all addresses.

    The folder has a short name, because Ray's sockets have long ones.
    """
    needs(find_spec("ray"), "Ray: pip install 'rosmop[ray]'")
    need_root()
    with own_loopback(), tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp") as folder:
        cluster = Cluster(Path(folder))
        try:
            cluster.start(0)
            yield cluster
        finally:
            eventually(lambda: not cluster.kill(), "all processes of the cluster have ended")


@dataclass(frozen=True)
class Finished:
    command: str
    out: str
    report: bytes


def words_of(command: str, place: str, report: Path) -> list[str]:
    return [*command.split(), "--bags", "bags", "--report", str(report), *place.split()]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with contextlib.chdir(tmp_path_factory.mktemp("recordings")):
        Path("limit.rv").write_text(SPECIFICATION)
        Path("bags").mkdir()
        for seed in range(RECORDINGS - 1):
            make_bag(Path("bags", f"{seed}.bag"), seed, MESSAGES)
        Path("bags/broken.bag").write_text("nonsense")
        yield


@pytest.fixture(scope="module", params=COMMANDS)
def expected(request: pytest.FixtureRequest, recordings: None) -> Finished:
    command, results = str(request.param), []
    for workers in ("1", "2"):
        words = words_of(command, f"--workers {workers}", Path(workers))
        done = subprocess.run(
            [str(BIN / "rosrv"), "monitor", *words], capture_output=True, text=True, check=False
        )
        assert done.returncode == SOME_FAILED, done.stderr
        results.append(Finished(command, done.stdout, Path(workers).read_bytes()))
    assert results[0] == results[1]
    return results[0]


def finished(command: str, process: "subprocess.Popen[str]", report: Path, cluster: Cluster) -> Finished:
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == SOME_FAILED, err + cluster.log()
    return Finished(command, out, report.read_bytes())


def test_a_node_gives_the_results_of_a_process(cluster: Cluster, expected: Finished, tmp_path: Path) -> None:
    report = tmp_path / "report"
    with cluster.start_rosrv(
        *words_of(expected.command, f"--on ray://127.0.0.1:{CLIENTS}", report)
    ) as process:
        assert finished(expected.command, process, report, cluster) == expected


def test_a_node_that_is_killed_changes_nothing(cluster: Cluster, expected: Finished, tmp_path: Path) -> None:
    for node in (1, 2):
        if not cluster.processes(str(node)):
            cluster.start(node)
    journal, report = tmp_path / "journal", tmp_path / "report"
    with cluster.start_rosrv(*words_of(expected.command, f"--on auto --resume {journal}", report)) as process:
        while not journal.exists() or journal.read_bytes().count(b"\n") <= RECORDINGS // 5:
            assert process.poll() is None
            threading.Event().wait(0.02)  # the rest of a command takes about a second on an idle machine
        assert cluster.kill("2") > 1
        assert finished(expected.command, process, report, cluster) == expected


def test_a_wrong_token_is_refused(cluster: Cluster, recordings: None) -> None:
    words = ("run", "limit.rv", "--bags", "bags", "--on", "auto")
    status, out, err = cluster.rosrv(*words, RAY_AUTH_TOKEN=secrets.token_hex(32))
    assert (status, out) == (2, "")
    assert "cannot use the cluster" in err
