"""Run PostgreSQL 15 in a temporary folder, on a Unix socket only, as the user postgres."""

import contextlib
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from tests.support.processes import runs
from tests.support.waiting import eventually

_PROGRAMS = Path("/usr/lib/postgresql/15/bin")


class PostgresCluster:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        account = pwd.getpwnam("postgres")
        self._as_postgres = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
        os.chown(folder, account.pw_uid, account.pw_gid)

    @property
    def data(self) -> Path:
        return self.folder / "data"

    def database(self, name: str) -> str:
        return f"host={self.folder} user=postgres dbname={name}"

    def make(self) -> None:
        command = [
            _PROGRAMS / "initdb",
            "--auth=trust",
            "--encoding=UTF8",
            "--locale=C.UTF-8",
            "--no-sync",
            "-D",
            self.data,
        ]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd="/", **self._as_postgres)  # type: ignore[call-overload]  # user, group

    def start(self, **settings: object) -> None:
        options = {"listen_addresses": "", "unix_socket_directories": self.folder, "fsync": "off", **settings}
        given = [part for name, value in options.items() for part in ("-c", f"{name}={value}")]
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [_PROGRAMS / "postgres", "-D", self.data, *given],
                stdout=log, stderr=log, cwd="/", **self._as_postgres,  # type: ignore[call-overload]  # user, group
            )  # fmt: skip
        eventually(
            self._answers,
            lambda: f"PostgreSQL accepts connections: {(self.folder / 'log').read_text()[-2000:]}",
        )

    def _answers(self) -> bool:
        try:
            psycopg.connect(self.database("postgres")).close()
        except psycopg.OperationalError:
            return False
        return True

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(120)
            self._process = None

    def kill(self) -> None:
        if self._process is not None:
            # Its processes have groups of their own; one that outlived the server would keep it from starting again.
            server = self._process.pid
            self._process.send_signal(signal.SIGSTOP)
            eventually(lambda: _is_stopped(server), "PostgreSQL starts no more processes")
            children = Path(f"/proc/{server}/task/{server}/children").read_text().split()
            for child in map(int, children):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            self._process.kill()
            self._process.wait()
            self._process = None
            eventually(lambda: not any(map(runs, children)), "all processes of PostgreSQL have ended")
            (self.data / "postmaster.pid").unlink(missing_ok=True)

    def create(self, name: str) -> str:
        with psycopg.connect(self.database("postgres"), autocommit=True) as connection:
            connection.execute(psycopg.sql.SQL("CREATE DATABASE {}").format(psycopg.sql.Identifier(name)))
        return self.database(name)


def _is_stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in ("T", "Z")


@contextmanager
def postgres() -> Iterator[PostgresCluster]:
    # A short path: the name of a Unix socket has at most 107 bytes.
    folder = Path(tempfile.mkdtemp(prefix="rosrv-pg-", dir="/tmp"))
    cluster = PostgresCluster(folder)
    try:
        cluster.make()
        cluster.start()
        yield cluster
    finally:
        cluster.kill()
        shutil.rmtree(folder)
