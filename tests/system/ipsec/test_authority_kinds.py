from pathlib import Path

from examples.landshark.lab import Lab
from tests.support.requirements import need_root
from tests.support.tunnel_site import TunnelSite
from tests.support.tunnels import need_strongswan


def test_an_encrypted_ed25519_authority(tmp_path: Path) -> None:
    need_root()
    need_strongswan()
    passphrase = tmp_path / "passphrase"
    passphrase.write_text("correct horse battery staple\n")
    passphrase.chmod(0o600)
    config = tmp_path / "appliance.yaml"
    config.write_text(f"ipsec: {{ca: ed25519, ca_passphrase_file: {passphrase}}}\n")
    with Lab("rosrv-ed25519") as lab:
        site = TunnelSite(lab, tmp_path, options=("--config", str(config)))
        with site:
            key = (site.appliance.state / "signer" / "ca.key").read_text()
            assert "ENCRYPTED PRIVATE KEY" in key
            with site.joined(site.kit()):
                site.is_up()
                mark = site.mark
                site.appliance.rosrv("host", "revoke", "ocu-1")
                site.recorded(mark, event="tunnel down")
                assert site.refused(mark)["decision"] == "deny"
            site.appliance.stop()
            passphrase.write_text("wrong\n")
            said = error_of_start(site)
            assert "the passphrase is wrong" in said
            assert "ca_passphrase_file" in said
            passphrase.write_text("correct horse battery staple\n")
            site.appliance.start()
            assert site.state() == "revoked"


def error_of_start(site: TunnelSite) -> str:
    try:
        site.appliance.start()
    except AssertionError as error:
        site.appliance.stop()
        return str(error)
    raise AssertionError("it started unexpectedly")
