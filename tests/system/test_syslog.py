import json
import os
import shutil
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.certificates import Certificates, make_certificates
from tests.support.processes import Process
from tests.support.requirements import need_root
from tests.support.rosmaster import master_at
from tests.support.syslog import parse
from tests.support.waiting import eventually

KEEPER = "10.83.0.9"
FORWARDER = (61017, 61014)  # its user, in the group that may read the log

_CONFIGURATION = """\
global(workDirectory="{folder}" maxMessageSize="16k" DefaultNetstreamDriver="gtls"
       DefaultNetstreamDriverCAFile="{tls.ca}" DefaultNetstreamDriverCertFile="{tls.certificate}"
       DefaultNetstreamDriverKeyFile="{tls.key}")
module(load="imtcp" StreamDriver.Name="gtls" StreamDriver.Mode="1" StreamDriver.AuthMode="x509/certvalid")
module(load="imudp")
input(type="imtcp" port="6514")
input(type="imudp" port="514")
template(name="asReceived" type="string" string="%rawmsg%\\n")
action(type="omfile" file="{file}" template="asReceived" asyncWriting="off" flushOnTXEnd="on")
"""


class Keeper:
    def __init__(self, host: Host, folder: Path) -> None:
        program = shutil.which("rsyslogd", path="/usr/sbin:/usr/bin")
        assert program is not None, "rsyslogd is missing: apt install rsyslog rsyslog-gnutls"
        self.host = host
        self.folder = folder
        self.file = folder / "received.log"
        self.tls = make_certificates(folder / "tls", KEEPER)
        configuration = folder / "rsyslog.conf"
        configuration.write_text(_CONFIGURATION.format(folder=folder, tls=self.tls, file=self.file))
        self._command = [program, "-n", "-f", str(configuration), "-i", str(folder / "rsyslog.pid")]

    @contextmanager
    def running(self) -> Iterator[None]:
        with Process(self.host, self._command, env={}, label="rsyslogd") as process:
            eventually(
                lambda: self.host.run(partial(_connects, KEEPER, 6514)) == "connected",
                "rsyslog accepts connections",
            )
            yield
            process.stop(with_signal=signal.SIGTERM)  # rsyslog ignores SIGINT

    def lines(self) -> list[str]:
        text = self.file.read_text(errors="replace") if self.file.exists() else ""
        return text.rpartition("\n")[0].splitlines()

    def sequences(self) -> set[int]:
        messages = [parse(line.encode()) for line in self.lines()]
        return {int(message.fields["sequence"]) for message in messages if "rosrv@32473" in message.elements}


def _connects(address: str, port: int) -> str:
    try:
        socket.create_connection((address, port), 2).close()
    except OSError as error:
        return type(error).__name__
    return "connected"


@pytest.fixture
def lab() -> Iterator[Lab]:
    need_root()
    with Lab("rosrv-slog") as lab:
        yield lab


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = Path(os.path.realpath("/tmp")) / f"rosrv-slog-{os.getpid()}"
    folder.mkdir(mode=0o755)
    yield folder
    shutil.rmtree(folder)


def configure(folder: Path, tls: Certificates, to: str, backend: str = "auto") -> Path:
    mine = folder / "forwarder.key"
    shutil.copy(tls.key, mine)
    os.chown(mine, *FORWARDER)
    mine.chmod(0o400)
    for one in (tls.ca.parent, tls.ca, tls.certificate):
        one.chmod(0o755 if one.is_dir() else 0o644)
    file = folder / "appliance.yaml"
    syslog = {"to": to}
    if to.startswith("tls"):
        syslog |= {"ca": "tls/ca.pem", "certificate": "tls/peer.pem", "key": "forwarder.key"}
    audit = {"checkpoint_seconds": 1, "syslog": syslog}
    file.write_text(json.dumps({"audit": audit, "firewall": {"backend": backend}}))
    return file


def set_parameters(uri: str, count: int) -> None:
    with master_at(uri) as master:
        for number in range(count):
            assert master.setParam("/worker", f"/value{number}", number)[0] == 1
        master.noSuchCall('/rogue"] \u202e')


def log_of(appliance: Appliance) -> set[int]:
    lines = appliance.rosrv("audit", "export").stdout.splitlines()
    return {json.loads(line)["sequence"] for line in lines}


@pytest.mark.parametrize("isolation", ["container", "netns"])
def test_another_machine_keeps_the_log(lab: Lab, folder: Path, isolation: str) -> None:
    machine, node = lab.host("machine", "10.83.0.2/24"), lab.host("node", "10.83.0.10/24")
    keeper = Keeper(lab.host("keeper", f"{KEEPER}/24"), folder)
    config = configure(folder, keeper.tls, f"tls://{KEEPER}:6514")
    with Appliance(machine, isolation=isolation, options=("--config", str(config))) as appliance:
        uri = "http://10.83.0.2:11311"
        with keeper.running():
            node.run(partial(set_parameters, uri, 30))
            wanted = log_of(appliance)
            eventually(lambda: wanted <= keeper.sequences(), "rsyslog has every record")
        before = log_of(appliance)
        node.run(partial(set_parameters, uri, 30))
        eventually(lambda: len(log_of(appliance) - before) >= 30, "the log has the calls")
        missed = log_of(appliance) - before
        assert not missed & keeper.sequences()
        with keeper.running():
            eventually(lambda: missed <= keeper.sequences(), "rsyslog has every record")
            eventually(
                lambda: sum("rosrvCheckpoint@32473" in line for line in keeper.lines()) >= 2,
                "checkpoints arrived",
            )
        verified = appliance.rosrv("audit", "verify", "--checkpoints", str(keeper.file))
        assert "kept elsewhere agree" in verified.stdout
        rogue = [parse(line.encode()) for line in keeper.lines() if "rogue" in line]
        assert {one.fields["caller_id"] for one in rogue} == {'/rogue"] \\u202e'}
        assert {one.fields["decision"] for one in rogue} == {"deny"}


def test_datagrams_to_rsyslog(lab: Lab, folder: Path) -> None:
    machine = lab.host("machine", "10.83.0.2/24")
    keeper = Keeper(lab.host("keeper", f"{KEEPER}/24"), folder)
    config = configure(folder, keeper.tls, f"udp://{KEEPER}:514")
    with keeper.running(), Appliance(machine, options=("--config", str(config))) as appliance:
        machine.run(partial(set_parameters, "http://10.83.0.2:11311", 30))
        wanted = log_of(appliance)
        eventually(lambda: wanted <= keeper.sequences(), "rsyslog has every record")


@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_the_forwarder_reaches_its_receiver_only(lab: Lab, folder: Path, backend: str) -> None:
    machine, other = lab.host("machine", "10.83.0.2/24"), lab.host("other", "10.83.0.66/24")
    keeper = Keeper(lab.host("keeper", f"{KEEPER}/24"), folder)
    config = configure(folder, keeper.tls, f"tls://{KEEPER}:6514", backend)
    listen = [sys.executable, "-c", _LISTEN]
    with (
        keeper.running(),
        Process(other, listen, env={}, label="other") as there,
        Process(keeper.host, listen, env={}, label="keeper's other port") as also,
        Appliance(machine, options=("--config", str(config))),
    ):
        there.wait_for_text("listening")
        also.wait_for_text("listening")
        places = [
            (KEEPER, 6514), (KEEPER, 7777), ("10.83.0.66", 7777), ("127.0.0.1", 11311), ("127.0.0.1", 12311),
        ]  # fmt: skip
        seen = {place: machine.run(partial(_as_user, FORWARDER, *place)) for place in places}
        assert seen.pop((KEEPER, 6514)) == "connected"
        assert set(seen.values()) <= {"TimeoutError", "ConnectionRefusedError"}, seen
        # Only its user is restricted, not the machine.
        assert machine.run(partial(_as_user, (61011, 61011), KEEPER, 7777)) == "connected"


_LISTEN = """
import socket
with socket.create_server(("", 7777)) as listener:
    print("listening", flush=True)
    while True:
        listener.accept()[0].close()
"""


def _as_user(account: tuple[int, int], address: str, port: int) -> str:
    here, there = os.pipe()
    child = os.fork()
    if child == 0:
        os.setgroups([])
        os.setresgid(*[account[1]] * 3)
        os.setresuid(*[account[0]] * 3)
        os.write(there, _connects(address, port).encode())
        os._exit(0)
    os.close(there)
    with os.fdopen(here) as answer:
        text = answer.read()
    os.waitpid(child, 0)
    return text
