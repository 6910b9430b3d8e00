"""Run a Docker engine for the tests only, on a host of the lab, whose namespace has its bridges and rules.

Images are built earlier, by an engine in this machine's network that leaves the network as it is. Both use the same
data in this machine's cache.
"""

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from appliance.network.namespaces import Namespace
from tests.support.debian_base import CACHE, base_archive
from tests.support.printed import row_of
from tests.support.processes import Host, ThisMachine
from tests.support.requirements import need_program, need_root

ROOT = Path(__file__).parents[2]
DATA = CACHE / "docker"
BASE = "rosrv-test/debian:12-slim"
APPLIANCE, DEMO = "rosrv/appliance", "rosrv/demo"
START_SECONDS = 60.0
BUILD_SECONDS = 900.0
HEALTHY_SECONDS = 120.0
# Replaces runc. The library is outside the container's files; time stamps of files stay unchanged.
_RUNTIME = """\
#!/usr/bin/python3
import json, os, sys

bundle = next((after for one, after in zip(sys.argv, sys.argv[1:]) if one == "--bundle"), None)
if bundle is not None and "create" in sys.argv:
    path = os.path.join(bundle, "config.json")
    config = json.load(open(path))
    config["process"]["env"] += ["LD_PRELOAD=/dev/later.so", "FAKETIME={ahead}", "NO_FAKE_STAT=1"]
    mount = {{"destination": "/dev/later.so", "type": "bind", "source": "{library}", "options": ["bind", "ro"]}}
    config["mounts"].append(mount)
    json.dump(config, open(path, "w"))
os.execvp("runc", ["runc", *sys.argv[1:]])
"""
_FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
Output = subprocess.CompletedProcess[str]


class DockerError(AssertionError):
    pass


class Engine:
    """A Docker engine. With `builds` it only builds images. With `clock` a test can change its containers' time."""

    def __init__(
        self, host: Host | None = None, *, builds: bool = False, clock: bool = False, data: Path = DATA
    ) -> None:
        need_root()
        self._program = need_program("dockerd", "docker.io")
        self._client = need_program("docker", "docker.io")
        self._compose = need_program("docker-compose", "docker-compose")
        self.host: Host = host or ThisMachine()
        self._builds = builds
        self._clock = clock
        self._data = data
        # short, for the sockets in it
        self.directory = Path(tempfile.mkdtemp(prefix="rosrv-engine-"))
        self._log = self.directory / "log"
        self._runtime = self.directory / "runtime"
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: int | None = None

    @property
    def address(self) -> str:
        return f"unix://{self.directory}/sock"

    def docker(
        self, *arguments: str, check: bool = True, timeout: float = 120, text: str | None = None
    ) -> Output:
        return self._run([self._client, *arguments], check=check, timeout=timeout, text=text)

    def inspect(self, name: str) -> dict[str, Any]:
        found: list[dict[str, Any]] = json.loads(self.docker("inspect", name).stdout)
        return found[0]

    def compose(self, directory: Path, project: str, *files: str, **environment: str) -> "Compose":
        return Compose(self, directory, project, files, {"LANDSHARK_REPORTS": "json", **environment})

    def build(self, target: str, tag: str, context: Path = ROOT) -> None:
        arguments = ("--network", "host", "--build-arg", f"BASE={BASE}", "--target", target, "--tag", tag)
        self.docker("build", *arguments, str(context), timeout=BUILD_SECONDS)

    def go_ahead(self, ahead: str) -> None:
        need_program("faketime", "faketime")
        self._runtime.write_text(_RUNTIME.format(ahead=ahead, library=_FAKETIME))

    def clear(self) -> None:
        left = self.docker("ps", "--all", "--quiet").stdout.split()
        if left:
            self.docker("rm", "--force", "--volumes", *left)
        self.docker("network", "prune", "--force")
        self.docker("volume", "prune", "--force")

    def start(self) -> Self:
        self._data.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self._data.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)  # the data is for one engine at a time
        command = [self._program, "--data-root", str(self._data), "--exec-root", str(self.directory / "exec")]
        command += ["--pidfile", str(self.directory / "pid"), "--host", self.address]
        if self._builds:
            # If the tests are killed, nothing else would end it (the lab ends only processes on its hosts).
            command = ["setpriv", "--pdeathsig", "TERM", *command]
            command += ["--bridge=none", "--iptables=false", "--ip-forward=false", "--ip-masq=false"]
        if self._clock:
            self._runtime.write_text('#!/bin/sh\nexec runc "$@"\n')
            self._runtime.chmod(0o755)
            command += ["--add-runtime", f"own={self._runtime}", "--default-runtime", "own"]
        with self._log.open("ab") as log:
            self._process = self.host.popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        deadline = time.monotonic() + START_SECONDS
        while self.docker("version", check=False).returncode:
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise DockerError(f"the engine did not start:\n{self.story()}")
        self.clear()
        return self

    def stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(60)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(60)
        for mount in _mounts_below(self.directory):
            subprocess.run(["umount", "--lazy", mount], check=False)
        shutil.rmtree(self.directory, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def story(self) -> str:
        lines = self._log.read_text(errors="backslashreplace").splitlines() if self._log.exists() else []
        return "\n".join(["--- dockerd", *(line for line in lines[-200:] if "level=info" not in line)][-40:])

    def _run(self, command: Sequence[str], *, check: bool, timeout: float, text: str | None = None) -> Output:
        return self.run_client(command, {}, Path("/"), check=check, timeout=timeout, text=text)

    def run_client(
        self,
        command: Sequence[str],
        environment: dict[str, str],
        directory: Path,
        *,
        check: bool,
        timeout: float,
        text: str | None = None,
    ) -> Output:
        kept = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("DOCKER_", "ROSRV_", "ROS_"))
        }
        done = subprocess.run(
            command,
            env=kept | {"DOCKER_HOST": self.address, "COMPOSE_HTTP_TIMEOUT": "120"} | environment,
            cwd=directory,
            input=text if text is not None else "",
            capture_output=True,
            text=True,
            errors="backslashreplace",
            timeout=timeout,
            check=False,
        )
        if check and done.returncode:
            said = "\n".join((done.stdout + done.stderr).splitlines()[-40:])
            raise DockerError(
                f"{' '.join(command)} ended with status {done.returncode}\n{said}\n{self.story()}"
            )
        return done

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:
            self.stop()
            raise

    def __exit__(self, *exc: object) -> None:
        try:
            with contextlib.suppress(DockerError, subprocess.TimeoutExpired):
                self.clear()
        finally:
            self.stop()


class MachineInside:
    address = "172.29.76.1"

    def __init__(self, machine: Host) -> None:
        self.popen = machine.popen


class Compose:
    def __init__(
        self, engine: Engine, directory: Path, project: str, files: Sequence[str], environment: dict[str, str]
    ) -> None:
        self.engine = engine
        self.directory = directory
        self.project = project
        self.environment = environment
        self._options = ["--project-name", project, "--ansi", "never"]
        for file in files:
            self._options += ["--file", file]

    def __call__(self, *arguments: str, check: bool = True, timeout: float = 180) -> Output:
        command = [shutil.which("docker-compose") or "docker-compose", *self._options, *arguments]
        return self.engine.run_client(command, self.environment, self.directory, check=check, timeout=timeout)

    def container(self, service: str) -> str:
        labels = (f"com.docker.compose.project={self.project}", f"com.docker.compose.service={service}")
        filters = [part for label in labels for part in ("--filter", f"label={label}")]
        found = self.engine.docker("ps", "--all", "--quiet", "--no-trunc", *filters).stdout.split()
        assert len(found) == 1, f"{service} has {len(found)} containers\n{self.story()}"
        return found[0]

    def exec(self, service: str, *command: str, check: bool = True, timeout: float = 60) -> Output:
        return self.engine.docker("exec", self.container(service), *command, check=check, timeout=timeout)

    def wait_healthy(self, service: str = "appliance", timeout: float = HEALTHY_SECONDS) -> None:
        container = self.container(service)
        since = self.engine.inspect(container)["State"]["StartedAt"]
        command = [
            "events",
            "--since",
            since,
            "--filter",
            f"container={container}",
            "--format",
            "{{.Status}}",
        ]
        for line in self._follow(command, timeout):
            if line == "health_status: healthy":
                return
            if line == "die":
                break
        state = self.engine.inspect(container)["State"]
        raise DockerError(f"{service} is not healthy: {json.dumps(state)[:2000]}\n{self.story()}")

    def wait_for_log(self, service: str, text: str, *, timeout: float = 60, since: str = "0s") -> str:
        moment = [] if since == "0s" else ["--since", since]
        for line in self._follow(["logs", "--follow", *moment, self.container(service)], timeout):
            if text in line:
                return line
        raise DockerError(f"{service} did not log {text!r} within {timeout:.0f} s\n{self.story()}")

    def _follow(self, command: Sequence[str], seconds: float) -> Iterator[str]:
        with subprocess.Popen(
            ["timeout", str(seconds), shutil.which("docker") or "docker", *command],
            env=os.environ | {"DOCKER_HOST": self.engine.address},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="backslashreplace",
        ) as follow:
            assert follow.stdout is not None
            try:
                for line in follow.stdout:
                    yield line.rstrip("\n")
            finally:
                follow.terminate()

    def audit(self, *flags: str, **fields: Any) -> list[dict[str, Any]]:
        lines = self.exec("appliance", "rosrv", "audit", "search", "--json", "--limit", "1000", *flags).stdout
        records: list[dict[str, Any]] = [
            json.loads(line) for line in lines.splitlines() if line.startswith("{")
        ]
        return [one for one in records if all(one.get(key) == value for key, value in fields.items())]

    def status(self) -> dict[str, Any]:
        return self.row("status")

    def row(self, *arguments: str, service: str = "appliance") -> dict[str, Any]:
        return row_of(self.exec(service, "rosrv", *arguments, "--json", check=False))

    def story(self) -> str:
        return self("--profile", "demo", "logs", "--no-color", "--tail", "40", check=False).stdout


def build_fleet() -> None:
    with builder() as engine, tempfile.TemporaryDirectory() as folder:
        network_and_base = {"network": "host", "args": {"BASE": BASE}}
        services = {name: {"build": network_and_base} for name in ("collector", "postgres")}
        override = Path(folder) / "override.json"
        override.write_text(json.dumps({"services": services}))
        compose = engine.compose(ROOT, "fleet", "fleet/compose.yaml", str(override))
        compose("build", timeout=BUILD_SECONDS)


def build_images() -> None:
    with builder() as engine:
        engine.build("appliance", APPLIANCE)
        engine.build("demo", DEMO)
        engine.docker("image", "prune", "--force", "--filter", "until=24h")


@contextlib.contextmanager
def builder(*, clock: bool = False) -> Iterator[Engine]:
    archive = base_archive()
    with Engine(builds=True, clock=clock) as engine:
        label = f"base={archive.stem}"
        known = engine.docker("images", "--quiet", "--filter", f"label={label}", BASE).stdout.strip()
        if not known:
            engine.docker("import", "--change", f"LABEL {label}", str(archive), BASE, timeout=300)
        yield engine


def project(directory: Path) -> Path:
    for name in ("compose.yaml", "compose.host.yaml", "compose.local.yaml", "compose.standby.yaml"):
        shutil.copy(ROOT / name, directory)
    for name in ("policies", "monitors"):
        shutil.copytree(ROOT / name, directory / name)
    (directory / "ipsec").mkdir()
    return directory


def project_beside(directory: Path) -> Path:
    """Make the project of a robot whose nodes run on the machine itself, as docs/install.md says."""
    page = (ROOT / "docs/install.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^    echo (COMPOSE_FILE=\S+) >> \.env$", page, re.MULTILINE)
    (project(directory) / ".env").write_text(f"{line}\n")
    return directory


def namespace_of(engine: Engine, container: str) -> Namespace:
    pid = engine.inspect(container)["State"]["Pid"]
    return _ContainerNamespace(int(pid))


class _ContainerNamespace(Namespace):
    def __init__(self, pid: int) -> None:
        self.name = f"container-{pid}"
        self.path = Path(f"/proc/{pid}/ns/net")


def _mounts_below(directory: Path) -> list[str]:
    lines = Path("/proc/self/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    below = [line.split()[1] for line in lines if line.split()[1].startswith(f"{directory}/")]
    return sorted(below, reverse=True)
