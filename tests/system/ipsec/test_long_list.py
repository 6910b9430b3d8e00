import sqlite3
import subprocess
import time
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.ipsec.certificate_authority import CertificateAuthority
from examples.landshark.lab import Lab
from tests.support.processes import LIMIT
from tests.support.requirements import need_root
from tests.support.tunnel_site import LONG, OCU, TunnelSite
from tests.support.tunnels import JoinedHost, need_strongswan

_FIRST = 1 << 70  # as long as the authority's serial numbers


def test_tunnels_work_with_thousands_of_revoked_certificates(tmp_path: Path) -> None:
    need_root()
    need_strongswan()
    with Lab("rosrv-list") as lab, TunnelSite(lab, tmp_path) as site:
        before = site.kit()
        present = site.kit("kit")
        site.appliance.stop()
        revoke_many(site.appliance.state / "control" / "state.db")
        site.appliance.start()
        mark = site.mark
        with site.join(before):
            refused = site.trail.wait_for(  # it may ask before the appliance's charon has its configuration
                lambda event: event.get("event") == "tunnel refused" and "revoked" in event["reason"],
                since=mark,
                timeout=LONG,
            )
            assert refused["host"] == OCU
        with site.joined(present) as joined:
            site.is_up()
            takes_such_a_list_itself(joined, tmp_path)
            mark = site.mark
            site.appliance.rosrv("host", "revoke", "ocu-1")
            site.recorded(mark, event="tunnel down")


def revoke_many(state: Path) -> None:
    now = time.time()
    names = ["ocu-1"] * 2_000 + ["gone"] * 3_000
    rows = [
        (f"{_FIRST + number:x}", name, now - 60 - number, now + 86_400) for number, name in enumerate(names)
    ]
    connection = sqlite3.connect(state)
    with connection:
        connection.executemany("INSERT INTO revocation VALUES (?, ?, ?, ?)", rows)
    connection.close()


def takes_such_a_list_itself(joined: JoinedHost, directory: Path) -> None:
    (directory / "ca").mkdir()
    signed = CertificateAuthority(directory / "ca").revocations(
        (f"{_FIRST + one:x}", 1.0) for one in range(2_200)
    )
    lists = joined.folder / "swanctl" / "x509crl"
    lists.mkdir()
    (lists / "rosrv.crl").write_bytes(x509.load_pem_x509_crl(signed).public_bytes(Encoding.DER))
    vici = ["--uri", f"unix://{joined.directory}/vici.sock"]
    done = joined.popen(
        ["swanctl", "--load-creds", "--noprompt", *vici],
        env={"SWANCTL_DIR": str(joined.folder / "swanctl"), "PATH": "/usr/sbin:/usr/bin"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    out, _ = done.communicate(timeout=LIMIT)
    assert done.returncode == 0, out
    said = next(line for line in out.splitlines() if "rosrv.crl" in line)
    assert said.startswith("loaded certificate from"), said
