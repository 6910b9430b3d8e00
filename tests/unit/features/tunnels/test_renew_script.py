import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

from appliance.features.tunnels.enrolment_kit import fill
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.ipsec.requests import make_key, signing_request

pytestmark = pytest.mark.nightly

CURL = """#!/bin/sh
for one; do url=$one; done
while [ $# -gt 0 ]; do
    case $1 in
        -o) out=$2 ;;
        -w) code=200 ;;
    esac
    shift
done
cp "$ANSWERS/$(basename "$url")" "$out" || exit 22
case $url in */renewed) code=204 ;; esac
printf '%s' "${code-}"
"""


class Host:
    def __init__(self, folder: Path) -> None:
        self.swanctl, self.answers, self._programs = folder / "swanctl", folder / "answers", folder / "bin"
        for path in (self.swanctl / "x509ca", self.swanctl / "x509", self.swanctl / "private", self.answers,
                     self._programs, folder / "ca", folder / "another"):  # fmt: skip
            path.mkdir(parents=True)
        self.authority = CertificateAuthority(folder / "ca")
        self.another = CertificateAuthority(folder / "another")
        key = make_key()
        self.key = self.swanctl / "private" / "rosrv.key"
        self.certificate = self.swanctl / "x509" / "rosrv.pem"
        self.key.write_bytes(key)
        made = self.authority.issue(signing_request(key, "laptop"), "laptop", 90)
        self.certificate.write_bytes(made.certificate)
        (self.swanctl / "x509ca" / "rosrv-ca.pem").write_bytes(self.authority.certificate)
        self.answer("revocations", self.authority.revocations([]))
        self.answer("renewed", b"")
        for name, text in (("curl", CURL), ("swanctl", "#!/bin/sh\n")):
            self.program(name, text)
        values = {"name": "laptop", "rest": "https://10.113.11.1:8443", "pin": "sha256//x"}
        (folder / "renew.sh").write_text(fill("renew.sh", values))
        self._script = folder / "renew.sh"

    def program(self, name: str, text: str) -> None:
        (self._programs / name).write_text(text)
        (self._programs / name).chmod(0o755)

    def fits(self) -> bool:
        key = load_pem_private_key(self.key.read_bytes(), None).public_key()
        return x509.load_pem_x509_certificate(self.certificate.read_bytes()).public_key() == key

    def answer(self, name: str, body: bytes) -> None:
        (self.answers / name).write_bytes(body)

    def renew(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        path = f"{self._programs}:{os.environ['PATH']}"
        environment = {"PATH": path, "SWANCTL_DIR": str(self.swanctl), "ANSWERS": str(self.answers)}
        command = ["sh", str(self._script), *arguments]
        return subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=60, check=False
        )

    @property
    def list_of_revoked(self) -> Path:
        return self.swanctl / "x509crl" / "rosrv.crl"


@pytest.fixture
def host(tmp_path: Path) -> Host:
    return Host(tmp_path)


def test_the_authoritys_list_of_revoked_certificates_is_kept(host: Host) -> None:
    done = host.renew()
    assert done.returncode == 0, done.stderr
    assert "nothing to do" in done.stdout
    given = x509.load_pem_x509_crl((host.answers / "revocations").read_bytes())
    assert host.list_of_revoked.read_bytes() == given.public_bytes(Encoding.DER)


def test_a_list_of_an_earlier_kit_is_removed(host: Host) -> None:
    """It has another name, and strongSwan would use whichever list it finds first."""
    earlier = host.swanctl / "x509crl" / "rosrv-crl.pem"
    earlier.parent.mkdir()
    earlier.write_bytes(host.authority.revocations([]))
    assert host.renew().returncode == 0
    assert [path.name for path in earlier.parent.iterdir()] == ["rosrv.crl"]


@pytest.mark.parametrize("forged", ["another authority's", "no list"])
def test_a_list_that_the_authority_did_not_sign_replaces_nothing(host: Host, forged: str) -> None:
    assert host.renew().returncode == 0
    kept = host.list_of_revoked.read_bytes()
    host.answer("revocations", b"rubbish" if forged == "no list" else host.another.revocations([("ab", 1.0)]))
    assert host.renew().returncode == 0
    assert host.list_of_revoked.read_bytes() == kept


@pytest.mark.parametrize(
    ("whose", "said"), [("another key's", "for another key"), ("another's", "not a certificate")]
)
def test_a_certificate_that_does_not_fit_replaces_nothing(host: Host, whose: str, said: str) -> None:
    before = host.certificate.read_bytes(), host.key.read_bytes()
    authority = host.authority if whose == "another key's" else host.another
    made = authority.issue(signing_request(make_key(), "laptop"), "laptop", 90).certificate
    host.answer("renew", json.dumps({"certificate": made.decode()}, separators=(",", ":")).encode())
    done = host.renew("--now")
    assert done.returncode == 1
    assert said in done.stderr
    assert (host.certificate.read_bytes(), host.key.read_bytes()) == before


# An appliance that renews: it issues for the host's request, and a confirmation puts that certificate into force.
RENEWING = f"""#!{sys.executable}
import base64, json, os, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[4])!r})
from appliance.ipsec.certificate_authority import CertificateAuthority

answers, given = Path(os.environ["ANSWERS"]), sys.argv
out, path = Path(given[given.index("-o") + 1]), given[-1].rpartition("/")[2]
current, following = answers / "current", answers / "next"
code = 200
if path == "revocations":
    out.write_bytes((answers / path).read_bytes())
elif path == "renew":
    body = json.loads(Path(given[given.index("--data-binary") + 1][1:]).read_text())
    made = CertificateAuthority(answers.parent / "ca").issue(
        body["request"].encode(), "laptop", 90,
        proof=base64.b64decode(body["proof"]), former=current.read_bytes(),
    ).certificate
    following.write_bytes(made)
    out.write_text(json.dumps({{"certificate": made.decode()}}, separators=(",", ":")))
elif following.exists():
    following.rename(current)
    code = 204
else:
    code = 422
print(code, end="")
"""
# The step with this number fails, or ends the script.
STEP = """#!/bin/sh
steps=$(($(cat "$ANSWERS/steps") + 1))
echo $steps > "$ANSWERS/steps"
if [ $steps = "$(cat "$ANSWERS/fails")" ]; then
    for one; do last=$one; done
    case $(cat "$ANSWERS/how") in
        killed) kill -KILL $PPID; sleep 1 ;;
        "full disk") [ NAME != install ] || : > "$last" ;;
    esac
    exit 1
fi
exec REAL "$@"
"""
_STEPS = ("install", "mv", "sync", "swanctl")


@pytest.mark.parametrize("how", ["killed", "full disk"])
def test_an_interruption_of_each_step_locks_the_host_out_of_nothing(host: Host, how: str) -> None:
    """Afterwards, charon has loaded the certificate that the appliance accepts."""
    current, loaded = host.answers / "current", host.answers / "loaded"
    for path in (current, loaded):
        path.write_bytes(host.certificate.read_bytes())
    (host.answers / "how").write_text(how)
    host.program("curl", RENEWING)
    load = 'cp "$SWANCTL_DIR/x509/rosrv.pem" "$ANSWERS/loaded"'
    for name in _STEPS:
        found = shutil.which(name) or ""
        real = f"sh -c '{load}' swanctl" if name == "swanctl" else found
        host.program(name, STEP.replace("NAME", name).replace("REAL", real))
    step = 0
    while True:
        step += 1
        for name, number in (("fails", step), ("steps", 0)):
            (host.answers / name).write_text(str(number))
        before = current.read_bytes()
        first = host.renew("--now")
        if (reached := int((host.answers / "steps").read_text())) >= step:
            assert first.returncode != 0, first.stdout
        # The host has the certificate that the appliance has confirmed, even if the script never runs again.
        if current.read_bytes() != before:
            assert host.fits()
            assert current.read_bytes() == host.certificate.read_bytes() == loaded.read_bytes()
        (host.answers / "fails").write_text("0")
        done = host.renew()
        assert done.returncode == 0, done.stderr
        assert host.fits()
        assert current.read_bytes() == host.certificate.read_bytes() == loaded.read_bytes()
        assert not host.key.with_suffix(".key.unconfirmed").exists()
        if reached < step:
            break
    assert step > 8


def test_a_certificate_that_is_lost_is_renewed_at_once(host: Host) -> None:
    """An earlier script left this after a full disk: the key of before still proves who asks."""
    (host.answers / "current").write_bytes(host.certificate.read_bytes())
    host.program("curl", RENEWING)
    host.key.with_suffix(".key.unconfirmed").write_bytes(host.key.read_bytes())
    host.key.write_bytes(make_key())
    host.certificate.write_bytes(b"")
    done = host.renew()
    assert done.returncode == 0, done.stderr
    assert host.fits()
