import json
import os
import subprocess
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.features.tunnels.enrolment_kit import filled
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
        self.authority, self.another = (
            CertificateAuthority(folder / "ca"),
            CertificateAuthority(folder / "another"),
        )
        key = make_key()
        self.key = self.swanctl / "private" / "rosrv.key"
        self.certificate = self.swanctl / "x509" / "rosrv.pem"
        self.key.write_bytes(key)
        self.certificate.write_bytes(
            self.authority.issue(signing_request(key, "laptop"), "laptop", 90).certificate
        )
        (self.swanctl / "x509ca" / "rosrv-ca.pem").write_bytes(self.authority.certificate)
        self.answer("revocations", self.authority.revocations([]))
        self.answer("renewed", b"")
        for name, text in (("curl", CURL), ("swanctl", "#!/bin/sh\n")):
            (self._programs / name).write_text(text)
            (self._programs / name).chmod(0o755)
        values = {"name": "laptop", "rest": "https://10.113.11.1:8443", "pin": "sha256//x"}
        (folder / "renew.sh").write_text(filled("renew.sh", values))
        self._script = folder / "renew.sh"

    def answer(self, name: str, body: bytes) -> None:
        (self.answers / name).write_bytes(body)

    def renew(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {
            "PATH": f"{self._programs}:{os.environ['PATH']}",
            "SWANCTL_DIR": str(self.swanctl),
            "ANSWERS": str(self.answers),
        }
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
