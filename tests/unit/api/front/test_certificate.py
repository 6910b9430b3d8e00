import datetime
import socket
import ssl
import stat
import subprocess
import threading
from pathlib import Path

import pytest

from appliance.api.front.certificate import CERTIFICATE, KEY, fingerprint_of, pin_of, renew, tls_context

NOW = datetime.datetime.now(datetime.UTC)


def shake_hands(context: ssl.SSLContext, certificate: Path, name: str) -> str | None:
    here, there = socket.socketpair()

    def serve() -> None:
        try:
            with context.wrap_socket(there, server_side=True) as sock:
                sock.recv(1)
        except OSError:
            there.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        client = ssl.create_default_context(cafile=certificate)
        with client.wrap_socket(here, server_hostname=name) as sock:
            return sock.version()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message
    finally:
        here.close()
        thread.join(10)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["10.1.2.3", "127.0.0.1", "::1", "localhost", "robot.example"])
def test_it_is_trusted_for_its_names(tmp_path: Path, name: str) -> None:
    context = tls_context(tmp_path, ["10.1.2.3", "robot.example"], NOW)
    assert shake_hands(context, tmp_path / CERTIFICATE, name) in ("TLSv1.2", "TLSv1.3")


@pytest.mark.nightly
def test_it_is_not_for_other_names(tmp_path: Path) -> None:
    said = shake_hands(tls_context(tmp_path, [], NOW), tmp_path / CERTIFICATE, "10.9.9.9")
    assert said is not None
    assert "mismatch" in said


def test_it_is_reused_and_only_its_owner_reads_the_key(tmp_path: Path) -> None:
    tls_context(tmp_path, ["10.1.2.3"], NOW)
    first = (tmp_path / CERTIFICATE).read_bytes()
    tls_context(tmp_path, ["10.1.2.3"], NOW + datetime.timedelta(days=100))
    assert (tmp_path / CERTIFICATE).read_bytes() == first
    assert stat.S_IMODE((tmp_path / KEY).stat().st_mode) == 0o600


def test_a_recreated_container_keeps_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    for name in ("0a1b2c3d4e5f", "f5e4d3c2b1a0", "rosrv", "robot-7"):
        monkeypatch.setattr(socket, "gethostname", lambda name=name: name)
        tls_context(tmp_path, ["10.1.2.3"], NOW)
        made.append(fingerprint_of(tmp_path))
    assert len(set(made)) == 1
    assert b"0a1b2c3d4e5f" not in ssl.PEM_cert_to_DER_cert((tmp_path / CERTIFICATE).read_text())
    tls_context(tmp_path, ["10.1.2.4"], NOW)
    assert b"robot-7" in ssl.PEM_cert_to_DER_cert((tmp_path / CERTIFICATE).read_text())


@pytest.mark.parametrize(("names", "days"), [(["10.1.2.4"], 0), (["10.1.2.3"], 800)])
def test_it_is_renewed_for_a_new_name_or_before_it_expires(
    tmp_path: Path, names: list[str], days: int
) -> None:
    """The key stays, so that pins stay valid."""
    tls_context(tmp_path, ["10.1.2.3"], NOW)
    first, pin = (tmp_path / CERTIFICATE).read_bytes(), pin_of(tmp_path)
    tls_context(tmp_path, names, NOW + datetime.timedelta(days=days))
    assert (tmp_path / CERTIFICATE).read_bytes() != first
    assert pin_of(tmp_path) == pin


@pytest.mark.nightly
@pytest.mark.parametrize("wrong", [datetime.timedelta(days=-20_000), datetime.timedelta(days=3650)])
def test_it_follows_a_corrected_clock(tmp_path: Path, wrong: datetime.timedelta) -> None:
    context = tls_context(tmp_path, ["10.1.2.3"], NOW + wrong)
    pin = pin_of(tmp_path)
    assert shake_hands(context, tmp_path / CERTIFICATE, "10.1.2.3") not in ("TLSv1.2", "TLSv1.3")
    assert renew(context, tmp_path, ["10.1.2.3"], NOW)
    assert shake_hands(context, tmp_path / CERTIFICATE, "10.1.2.3") in ("TLSv1.2", "TLSv1.3")
    for now in (
        NOW,
        datetime.datetime.fromtimestamp(0, datetime.UTC),
    ):  # the clock is back in 1970 at the next start
        assert not renew(context, tmp_path, ["10.1.2.3"], now)
    assert pin_of(tmp_path) == pin


@pytest.mark.nightly
def test_a_pin_is_the_hash_of_the_key(tmp_path: Path) -> None:
    tls_context(tmp_path, [], NOW)
    pipe = "openssl x509 -pubkey -noout | openssl pkey -pubin -outform der"
    pipe += " | openssl dgst -sha256 -binary | openssl base64"
    done = subprocess.run(
        ["/bin/sh", "-c", pipe], input=(tmp_path / CERTIFICATE).read_bytes(), capture_output=True, check=True
    )
    assert pin_of(tmp_path) == f"sha256//{done.stdout.decode().strip()}"
    (tmp_path / "other").mkdir()
    tls_context(tmp_path / "other", [], NOW)
    assert pin_of(tmp_path / "other") != pin_of(tmp_path)


def test_an_unusable_certificate_is_an_error(tmp_path: Path) -> None:
    """A host may have pinned it, so it is not silently replaced."""
    tls_context(tmp_path, [], NOW)
    (tmp_path / CERTIFICATE).write_text("-----BEGIN CERTIFICATE-----\nnonsense\n-----END CERTIFICATE-----\n")
    with pytest.raises(
        ValueError, match=rf"{tmp_path}: certificate\.pem or key\.pem is damaged: restore both"
    ):
        tls_context(tmp_path, [], NOW)
