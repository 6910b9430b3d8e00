from pathlib import Path

import pytest
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.server import ServerCertificateError, authority_of, make_certificate, url_of

from appliance.signing.own_certificate import make_own_certificate
from tests.support.certificates import make_certificates


def config_in(folder: Path, listen: str = "0.0.0.0:8444") -> FleetConfig:
    return FleetConfig(certificate=folder / "server.pem", key=folder / "server.key", listen=listen)


@pytest.mark.parametrize(
    ("address", "url"), [("10.0.0.9", "https://10.0.0.9:8444"), ("fd00::9", "https://[fd00::9]:8444")]
)
def test_a_certificate_is_made_once(address: str, url: str, tmp_path: Path) -> None:
    config = config_in(tmp_path)
    assert make_certificate(config, address)
    made = config.certificate.read_text()
    assert not make_certificate(config, address)
    assert not make_certificate(config, None)
    assert (url_of(config), authority_of(config.certificate)) == (url, made)
    assert config.key.stat().st_mode & 0o777 == 0o600
    with pytest.raises(ServerCertificateError, match=f"names {address}: to replace it, remove it"):
        make_certificate(config, "10.0.0.8")


@pytest.mark.parametrize("address", [None, "collector.example", ""])
def test_a_certificate_needs_an_address(address: str | None, tmp_path: Path) -> None:
    with pytest.raises(ServerCertificateError, match="give --address"):
        make_certificate(config_in(tmp_path), address)
    assert list(tmp_path.iterdir()) == []


def test_a_certificate_of_an_authority_ends_with_it(tmp_path: Path) -> None:
    own = make_certificates(tmp_path / "own", "10.0.0.9")
    config = config_in(tmp_path)
    config.certificate.write_bytes(own.certificate.read_bytes())
    with pytest.raises(ServerCertificateError, match="append it"):
        authority_of(config.certificate)
    config.certificate.write_bytes(own.certificate.read_bytes() + own.ca.read_bytes())
    assert authority_of(config.certificate) == own.ca.read_text()
    assert url_of(config) == "https://10.0.0.9:8444"


def test_robots_need_an_ip_address(tmp_path: Path) -> None:
    """Robots do not resolve names."""
    config = config_in(tmp_path)
    config.certificate.write_bytes(make_own_certificate("collector", 1)[1])
    with pytest.raises(ServerCertificateError, match="names no IP address"):
        url_of(config)
