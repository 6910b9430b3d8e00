"""Start `rosrv up` as a user would, and read its audit log and processes."""

import contextlib
import json
import os
import signal
import ssl
import subprocess
import tempfile
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from appliance.channel.admin import A, AdminRequest
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from tests.support.command import ROSRV, rosrv
from tests.support.own_namespace import own_namespace
from tests.support.printed import row_of, rows_of
from tests.support.processes import LIMIT, Event, Host, Process, ThisMachine
from tests.support.rest import Rest
from tests.support.waiting import NoAnswerError, eventually

OPEN_POLICY = """\
[Nodes]
default = *
[Publishers]
default = *
[Subscribers]
default = *
[Commands]
default = *
"""

_FLAGS = {"event": "--event", "host": "--host"}
"""The fields whose search is faster than reading every record."""


class Appliance:
    def __init__(
        self,
        host: Host | None = None,
        *,
        policy: str = OPEN_POLICY,
        isolation: str | None = None,
        settings: str = "",
        monitors: Mapping[str, str] | None = None,
        options: tuple[str, ...] = (),
        json: bool = True,
        relays: int = 1,
    ) -> None:
        """Write the configuration. With `json=False` the output is for a person.

        `settings` is the text of appliance.yaml. `relays` is the number of relay processes, the same on every
        machine.
        """
        self.relays = relays
        self.host: Host = host or ThisMachine()
        self.isolation = isolation or ("none" if isinstance(self.host, ThisMachine) else "container")
        self.json = json
        # pytest's folder is closed to the users that the appliance's processes run as
        self.directory = Path(tempfile.mkdtemp(prefix="rosrv-test-"))
        self.directory.chmod(0o755)
        self.state = self.directory / "state"
        self.policy_file = self.directory / "policy.ini"
        self.policy_file.write_text(policy)
        self.options = (*self._options_of_files(settings, monitors), *options)
        self.process: Process | None = None
        self.ready: Event = {}
        self.token = ""  # the first token, printed at the first start
        self._looked_at = 0  # the last record that `audit` leaves out
        self._turn = contextlib.ExitStack()  # with isolation netns: until it is closed
        self._has_turn = False

    def _options_of_files(self, settings: str, monitors: Mapping[str, str] | None) -> Iterator[str]:
        if settings:
            file = self.directory / "appliance.yaml"
            file.write_text(settings)
            yield from ("--config", str(file))
        if monitors is not None:
            folder = self.directory / "monitors"
            folder.mkdir()
            for name, text in monitors.items():
                (folder / f"{name}.rv").write_text(text)
            yield from ("--monitors", str(folder))

    @property
    def master_uri(self) -> str:
        return str(self.ready["master"])

    def start(self) -> Self:
        if self.isolation == "netns" and not self._has_turn:
            self._turn.enter_context(own_namespace())
            self._has_turn = True
        loopback = isinstance(self.host, ThisMachine)
        command = [
            ROSRV,
            "up",
            *(["--json"] if self.json else []),
            "--isolation",
            self.isolation,
            "--state",
            str(self.state),
        ]
        command += ["--policy", str(self.policy_file)]
        inside = "0.0.0.0" if self.isolation == "netns" else self.host.address
        command += ["--listen", "127.0.0.1:0" if loopback else f"{inside}:11311"]
        if loopback:
            command += ["--rosmaster-port", "0"]
        command += self.options  # last, because the last value of a repeated flag counts
        environment = _environment() | {"ROSRV_RELAYS": str(self.relays)}
        self.process = Process(self.host, command, env=environment, label="rosrv up")
        if self.json:
            self.ready = self.process.wait_for(event="ready", timeout=2 * LIMIT)
            self.token = self.ready.get("token", self.token)
        else:
            self.process.wait_for_text("Nodes may connect", timeout=60)
        return self

    def stop(self) -> int:
        return self.process.stop(with_signal=signal.SIGTERM, timeout=10) if self.process else 0

    def rosrv(
        self, *arguments: str, check: bool = True, state: bool = True
    ) -> subprocess.CompletedProcess[str]:
        done = rosrv(*arguments, *(["--state", str(self.state)] if state else []))
        if check and done.returncode:
            raise NoAnswerError(
                f"{' '.join(done.args)}: exit status {done.returncode}\n"
                f"{done.stdout}\n{done.stderr}\n{self.story()}"
            )
        return done

    def rows(self, *arguments: str) -> list[dict[str, Any]]:
        return rows_of(self.rosrv(*arguments, "--json", check=False))

    def row(self, *arguments: str) -> dict[str, Any]:
        return row_of(self.rosrv(*arguments, "--json", check=False))

    def ask(self, request: AdminRequest[A]) -> A:
        try:
            answer = AdminSocket(self.state).ask(request)
        except NotRunningError as error:
            raise NoAnswerError(str(error)) from None
        if not answer.ok:
            raise NoAnswerError(answer.error)
        return answer.unwrap()

    def status(self) -> dict[str, Any]:
        return self.row("status")

    def audit(self, *flags: str, **fields: Any) -> list[dict[str, Any]]:
        whole = () if "--limit" in flags else ("--limit", "10000")
        named = [f"{flag}={fields[name]}" for name, flag in _FLAGS.items() if fields.get(name)]
        lines = self.rosrv("audit", "search", *named, *flags, *whole, "--json").stdout.splitlines()
        records: list[dict[str, Any]] = [json.loads(line) for line in lines if line.strip()]
        return [
            record
            for record in records
            if record["sequence"] > self._looked_at
            and all(record.get(key) == value for key, value in fields.items())
        ]

    def ignore_earlier_records(self) -> None:
        self._looked_at = max(
            (record["sequence"] for record in self.audit("--limit", "1")), default=self._looked_at
        )

    def recorded(self, *flags: str, count: int = 1, **fields: Any) -> list[dict[str, Any]]:
        """Wait for `count` matching records, which are written shortly after the event."""

        def found() -> list[dict[str, Any]] | None:
            records = self.audit(*flags, **fields)
            return records if len(records) >= count else None

        return eventually(found, lambda: f"{count} records {flags} {fields}\n{self.story()}")

    def reload(self, policy: str) -> None:
        self.policy_file.write_text(policy)
        self.rosrv("policy", "reload")

    def rest(self, token: str | None = None) -> Rest:
        url = str(self.ready["api"])
        certificate = None
        if url.startswith("https:"):
            # The kernel accepts connections before the process is ready: one answer shows that it is.
            place = urllib.parse.urlsplit(url)
            served = ssl.get_server_certificate((str(place.hostname), place.port or 443), timeout=LIMIT)
            certificate = self.state / "api" / "certificate.pem"
            assert certificate.read_text() == served
        client = Rest(url, token or self.token, certificate)
        # The api answers 503 until it has read its tokens.
        eventually(lambda: b"the appliance is starting" not in client.get("/v1/status").body, self.story)
        return client

    def processes(self) -> dict[str, dict[str, Any]]:
        """Wait until every process has reported its sandbox, and return the processes by role."""

        def told() -> dict[str, dict[str, Any]] | None:
            rows = self.status()["processes"]
            if any(not row["sandbox"] and row["role"] != "supervisor" for row in rows):
                return None
            return {row["role"]: row for row in rows}

        return eventually(told, self.story)

    def pids(self, role: str) -> list[int]:
        return [row["pid"] for row in self.status()["processes"] if row["role"] == role and row["pid"]]

    def kill(self, role: str) -> int:
        pid = eventually(lambda: self.pids(role), self.story)[0]
        os.kill(pid, signal.SIGKILL)
        return pid

    def story(self) -> str:
        return self.process.story() if self.process else "rosrv up was not started"

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        with self._turn:
            self.stop()
        subprocess.run(["/bin/rm", "-rf", str(self.directory)], check=True)


def _environment() -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "ROSRV_"))}
    return kept | {"PYTHONUNBUFFERED": "1"}
