"""The kit's `join.sh`, with folders in place of `/etc` and `/run`.

The real `openssl` reads certificates, with the spelling of the tested version.
"""

import os
import re
import shutil
import socket
import subprocess
import time
from collections import defaultdict
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.features.tunnels.enrolment_kit import fill
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.ipsec.requests import make_key, signing_request
from appliance.network.close_ports import RANGE_FILE, protection
from appliance.network.firewall.firewall_rules import PortRange
from tests.support.virtual_clock import VirtualClock
from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly

SPELLINGS = {"before 3.2": "s/CN *= */CN = /; s/O *= */O = /", "3.2": "s/CN *= */CN=/; s/O *= */O=/"}


def ran(*command: str, path: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=cwd, env={"PATH": path}, capture_output=True, text=True, timeout=60, check=False
    )


class Machine:
    def __init__(self, folder: Path, spelling: str) -> None:
        self._folder, self._authority = folder, CertificateAuthority(folder)
        self._kit, self._etc, programs = folder / "kit/swanctl", folder / "etc", folder / "bin"
        for root in (self._kit, self._etc):
            for part in ("x509", "x509ca", "private"):
                (root / part).mkdir(parents=True)
            (root / "private/rosrv.key").write_bytes(make_key())
            (root / "x509ca/rosrv-ca.pem").write_bytes(self._authority.certificate)
        programs.mkdir()
        real = shutil.which("openssl")
        assert real is not None
        (programs / "openssl").write_text(f"#!/bin/sh\n{real} \"$@\" | sed '/^subject/{{{spelling}}}'\n")
        (programs / "openssl").chmod(0o755)
        self._path = f"{programs}:{os.environ['PATH']}"

    def put(self, where: str, name: str, made_days_ago: float, days: float) -> None:
        with clock.using(VirtualClock(wall=time.time() - made_days_ago * 86_400.0)):
            made = self._authority.issue(signing_request(make_key(), name), name, days).certificate
        root = self._kit if where == "kit" else self._etc
        (root / "x509/rosrv.pem").write_bytes(made)

    def keeps_what_is_in_place(self) -> bool:
        text = fill("join.sh", defaultdict(str, name="laptop"))
        begin, end = text.index("begin() {"), text.index("\n}\n", text.index("renewed() {")) + 3
        script = text[begin:end].replace("/etc/swanctl", str(self._etc)) + "renewed\n"
        done = ran("sh", "-eu", "-c", script, path=self._path, cwd=self._kit.parent)
        assert done.stderr == ""
        return done.returncode == 0


@pytest.mark.parametrize("openssl", SPELLINGS)
def test_a_renewed_certificate_stays(tmp_path: Path, openssl: str) -> None:
    """When join.sh runs again, it must recognise the certificate however openssl writes a name."""
    machine = Machine(tmp_path, SPELLINGS[openssl])
    machine.put("kit", "laptop", 3, 90)
    machine.put("etc", "laptop", 1, 30)
    assert machine.keeps_what_is_in_place()


@pytest.mark.parametrize("openssl", SPELLINGS)
@pytest.mark.parametrize(
    ("name", "made_days_ago"), [("laptop-2", 1), ("my-laptop", 1), ("laptop", 5), ("laptop", -1)]
)
def test_any_other_certificate_is_replaced(
    tmp_path: Path, openssl: str, name: str, made_days_ago: float
) -> None:
    """The kit's counts even if it ends earlier, or if the clock was ahead before: the other one is revoked."""
    machine = Machine(tmp_path, SPELLINGS[openssl])
    machine.put("kit", "laptop", 3, 30)
    machine.put("etc", name, made_days_ago, 90)
    assert not machine.keeps_what_is_in_place()


@pytest.mark.parametrize(
    ("closed", "warned"),
    [((0, 0), False), ((-100, 100), False), ((1, 0), True), ((0, -1), True)],
    ids=["the same", "more", "from a later port", "to an earlier port"],
)
def test_a_machine_with_other_ports_than_the_kit_is_warned(
    tmp_path: Path, closed: tuple[int, int], warned: bool
) -> None:
    """The kernel's own file is read: a shell that reads it byte by byte gets only the first one."""
    first, last = map(int, RANGE_FILE.read_text().split())
    text = fill("join.sh", defaultdict(str, name="laptop"))
    begin, end = text.index("closed=$("), text.index("\nfi\n", text.index("closed=$(")) + 4
    say = "".join(line for line in text.splitlines(True) if line.startswith("say()"))
    ports = PortRange(first + closed[0], last + closed[1])
    (tmp_path / "protect.nft").write_text(protection(["10.113.11.1"], ports, ()))
    done = subprocess.run(
        ["dash", "-eu", "-c", say + text[begin:end]], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert (f"--ports {first}-{last}" in done.stdout) == ("warning" in done.stdout) == warned


@pytest.mark.parametrize(("sas", "status"), [("ros{1}: INSTALLED", 0), ("", 1)])
def test_output_of_charon_is_shown_only_after_a_failure(tmp_path: Path, sas: str, status: int) -> None:
    text = fill("join.sh", defaultdict(str, name="laptop", endpoint="10.0.0.2", connections="rosrv rosrv-2"))
    begin, end = text.index('say "waiting for'), text.index("\nfi\n", text.index("INSTALLED")) + 4
    functions = "".join(line for line in text.splitlines(True) if line.startswith(("die()", "say()")))
    swanctl = tmp_path / "swanctl"
    swanctl.write_text(
        "#!/bin/sh\ncase $1 in\n--initiate) echo '[IKE] received AUTHENTICATION_FAILED'; exit 1;;\n"
        f"*) echo '{sas}';;\nesac\n"
    )
    swanctl.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = ran("sh", "-eu", "-c", f"{functions}{text[begin:end]}", path=path)
    assert done.returncode == status
    assert done.stdout == "join.sh: waiting for the tunnel to 10.0.0.2\n"
    assert ("AUTHENTICATION_FAILED" in done.stderr) == ("rosrv audit search" in done.stderr) == bool(status)


def test_a_long_log_begins_again(tmp_path: Path) -> None:
    (line,) = [one.strip() for one in fill("join.sh", defaultdict(str)).splitlines() if "for log in" in one]
    long, short = tmp_path / "charon.log", tmp_path / "keep.log"
    long.write_bytes(b"x" * 1_000_000)
    short.write_bytes(b"x" * 999_999)
    with long.open("ab", buffering=0) as writer:
        subprocess.run(["dash", "-eu", "-c", line.replace("/run/rosrv", str(tmp_path))], check=True)
        writer.write(b"next")
    assert (long.read_bytes(), short.stat().st_size) == (b"next", 999_999)


PROGRAM = """\
#!/bin/sh
call="${{0##*/}} $*"
echo "$call" >> calls
case $call in
{failure};;
"id -u") echo 0;;
"dpkg-query "*) echo install ok installed;;
"systemctl is-enabled "*) [ -e {root}/run/rosrv/keep.pid ];;
"setsid charon-systemd") ln -s {root}/socket {root}/run/charon.vici;;
"swanctl --list-sas "*) echo INSTALLED;;
esac
"""
FAILURES = {
    "charon": '"systemctl restart strongswan.service" | "setsid charon-systemd") exit 1',
    "configuration": '"swanctl --load-all "*) exit 1',
    "tunnel": '"swanctl --list-sas "*) exit 1',
    "answer": '"ping "*) exit 1',
    "terminal": '"ping "*) kill -HUP $PPID',
    "none": '"") exit 1',
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("joined", [True, False], ids=["joined before", "first"])
@pytest.mark.parametrize("systemd", [True, False], ids=["systemd", "container"])
def test_a_failed_run_leaves_a_joined_host_its_keeper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, systemd: bool, joined: bool, failure: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("bin", "etc/strongswan.d/charon", "etc/systemd/system", "run/rosrv", "swanctl/private"):
        Path(folder).mkdir(parents=True)
    for folder in ("swanctl/x509", "swanctl/x509ca", *(["run/systemd/system"] if systemd else [])):
        Path(folder).mkdir(parents=True)
    for file in ("private/rosrv.key", "x509/rosrv.pem", "x509ca/rosrv-ca.pem", "swanctl.conf"):
        Path("swanctl", file).touch()
    for file in ("keep.sh", "renew.sh", "leave.sh", *(["run/rosrv/keep.pid"] if joined else [])):
        Path(file).touch()
    Path("protect.nft").write_text(protection(["10.113.11.1"], PortRange(1, 65535), ()))
    for name in ("id", "dpkg-query", "nft", "ip", "systemctl", "setsid", "swanctl", "ping", "curl", "sleep"):
        Path("bin", name).write_text(PROGRAM.format(failure=FAILURES[failure], root=tmp_path))
        Path("bin", name).chmod(0o755)
    script = fill("join.sh", defaultdict(str, name="laptop", connections="rosrv"))
    Path("join.sh").write_text(re.sub(r"(?<![\w/])/(?=(etc|run)/)", f"{tmp_path}/", script))
    with socket.socket(socket.AF_UNIX) as charon:
        charon.bind("socket")
        done = ran("dash", "join.sh", path=f"{tmp_path}/bin:{os.environ['PATH']}")
    assert (done.returncode == 0) == (failure == "none"), done.stderr
    keeper = "systemctl restart rosrv-tunnel.service" if systemd else f"setsid {tmp_path}/etc/rosrv/keep.sh"
    times = int(joined or failure == "none")  # a container's keeper starts in the background
    eventually(lambda: Path("calls").read_text().splitlines().count(keeper) == times, lambda: done.stderr)
    calls = Path("calls").read_text().splitlines()
    charon_calls = [place for place, call in enumerate(calls) if call.startswith(("swanctl", "ping"))]
    assert keeper not in calls[: max(charon_calls, default=0)], (
        "the keeper asks for tunnels beside the script"
    )
