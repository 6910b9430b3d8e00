"""The script with which a host enrols itself, with a false appliance in place of `curl`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

from appliance.features.tunnels.enrolment_kit import fill
from appliance.ipsec.certificate_authority import CertificateAuthority

pytestmark = pytest.mark.nightly

CURL = f"""#!{sys.executable}
import io, json, os, sys, tarfile
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[4])!r})
from appliance.ipsec.certificate_authority import CertificateAuthority

home, given = Path(os.environ["HOME"]), sys.argv
body = json.loads(Path(given[given.index("--data-binary") + 1][1:]).read_text())
answer, cut = Path(given[given.index("-o") + 1]), home / "cut"
place = cut.read_text() if cut.exists() else ""
cut.unlink(missing_ok=True)
if place == "the request":
    sys.exit(7)
with (home / "tokens").open("a") as tokens:
    tokens.write(body["token"] + "\\n")
used = home / ("used-" + body["token"])
if body["token"] == "wrong" or (used.exists() and used.read_text() != body["request"]):
    answer.write_text("no")
    print(403, end="")
    sys.exit()
used.write_text(body["request"])
authority = CertificateAuthority(home / "ca")
made = authority.issue(body["request"].encode(), "laptop", 90).certificate
if place == "the answer":
    sys.exit(52)
with tarfile.open(answer, "w:gz") as kit:
    for name, text in (
        ("swanctl/x509ca/rosrv-ca.pem", authority.certificate),
        ("swanctl/x509/rosrv.pem", made),
        ("join.sh", b"echo joined with the kit of " + body["token"].encode()),
    ):
        entry = tarfile.TarInfo("rosrv-laptop/" + name)
        entry.size = len(text)
        kit.addfile(entry, io.BytesIO(text))
if place == "half of the answer":
    os.truncate(answer, answer.stat().st_size // 2)
print(200, end="")
"""


class Host:
    def __init__(self, home: Path) -> None:
        self._home, self._programs = home, home / "bin"
        self._programs.mkdir()
        (home / "ca").mkdir()
        authority = x509.load_pem_x509_certificate(CertificateAuthority(home / "ca").certificate)
        self._authority = authority.fingerprint(hashes.SHA256()).hex()
        for name, text in (("curl", CURL), ("id", "#!/bin/sh\necho 0\n")):
            self.program(name, text)
        self.folder = home / "rosrv"

    def program(self, name: str, text: str) -> None:
        (self._programs / name).write_text(text)
        (self._programs / name).chmod(0o755)

    def run(self, token_id: str, *arguments: str, said: str = "") -> subprocess.CompletedProcess[str]:
        values = {"name": "laptop", "url": "https://10.0.0.1:8443", "pin": "sha256//x", "id": token_id}
        script = self._home / f"join-{token_id}.sh"
        script.write_text(fill("enrol.sh", values | {"authority": self._authority}))
        path = f"{self._programs}:{os.environ['PATH']}"
        environment = {"PATH": path, "HOME": str(self._home), "ROSRV_FOLDER": str(self.folder)}
        command = ["sh", str(script), *arguments]
        return subprocess.run(
            command, env=environment, input=said, capture_output=True, text=True, timeout=60, check=False
        )

    def cut(self, place: str) -> None:
        """Lose a part of the next connection."""
        (self._home / "cut").write_text(place)

    @property
    def key(self) -> bytes:
        """The kit's private key, which fits its certificate."""
        swanctl = self.folder / "rosrv-laptop/swanctl"
        key = (swanctl / "private/rosrv.key").read_bytes()
        certificate = x509.load_pem_x509_certificate((swanctl / "x509/rosrv.pem").read_bytes())
        public = [
            one.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
            for one in (load_pem_private_key(key, None).public_key(), certificate.public_key())
        ]
        assert public[0] == public[1]
        return key

    @property
    def tokens(self) -> list[str]:
        path = self._home / "tokens"
        return path.read_text().split() if path.exists() else []


@pytest.fixture
def host(tmp_path: Path) -> Host:
    return Host(tmp_path)


def test_each_token_enrols_with_a_key_of_its_own(host: Host) -> None:
    """Run again, a script repairs; the script of another token asks for it, and joins with its own kit."""
    assert host.run("aa", "first").stdout.strip() == "joined with the kit of first"
    key = host.key
    again = host.run("aa")
    assert "already enrolled" in again.stdout and "joined with the kit of first" in again.stdout
    assert host.key == key
    anew = host.run("bb", said="second\n")
    assert "one-time token" in anew.stderr
    assert anew.stdout.strip() == "joined with the kit of second"
    assert host.key != key
    assert "already enrolled" in host.run("bb").stdout
    assert host.tokens == ["first", "second"]
    assert sorted(path.name for path in host.folder.iterdir()) == ["rosrv-laptop"]


@pytest.mark.parametrize("what", ["a wrong token", "no answer"])
def test_a_refused_token_takes_nothing_away(host: Host, what: str) -> None:
    host.run("aa", "first")
    key = host.key
    if what == "no answer":
        host.program("curl", "#!/bin/sh\nexit 7\n")
    assert host.run("bb", "wrong").returncode == 1
    assert host.key == key
    assert "joined with the kit of first" in host.run("aa").stdout


@pytest.mark.parametrize("place", ["the request", "the answer", "half of the answer"])
def test_a_lost_connection_costs_neither_the_token_nor_the_key(host: Host, place: str) -> None:
    host.run("aa", "first")
    host.cut(place)
    token = "rosrv-enrol_bb_x"  # noqa: S105  its form matters
    assert host.run("bb", token).returncode != 0
    wanted = (host.folder / "new/rosrv.key").read_bytes()
    assert f"joined with the kit of {token}" in host.run("bb", token).stdout
    assert host.key == wanted
    again = host.run("bb", token)
    assert "already enrolled" in again.stdout and host.key == wanted
    assert sorted(path.name for path in host.folder.iterdir()) == ["rosrv-laptop"]


def test_another_key_with_a_used_token_is_refused(host: Host) -> None:
    host.cut("the answer")
    assert host.run("aa", "first").returncode == 1
    shutil.rmtree(host.folder)
    assert "the appliance refused (403)" in host.run("aa", "first").stderr


@pytest.mark.parametrize("program", ["rm", "mv"])
def test_a_certified_kit_is_taken_after_an_interruption(host: Host, program: str) -> None:
    """The token is used up by then: the next run must not need it."""
    host.run("aa", "first")
    real = shutil.which(program)
    host.program(program, f'#!/bin/sh\ncase "$*" in *rosrv/rosrv-laptop) exit 1 ;; esac\nexec {real} "$@"\n')
    assert host.run("bb", "second").returncode == 1
    host.program(program, f'#!/bin/sh\nexec {real} "$@"\n')
    assert "joined with the kit of second" in host.run("bb").stdout
    assert host.tokens == ["first", "second"]
    assert host.key
