import hashlib
import ssl
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from rosrv_fleet.robots import Robots
from rosrv_fleet.server import ServerTls

from tests.support.certificates import Certificates, make_certificates


def _shown(tls: ServerTls, client: Certificates, server: Certificates) -> bytes | None:
    context = ssl.create_default_context(cafile=server.ca)
    context.load_cert_chain(client.certificate, client.key)
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    asking = context.wrap_bio(down, up, server_hostname="127.0.0.1")
    answering = tls.context.wrap_bio(up, down, server_side=True)
    for end in (asking, answering, asking, answering):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
    return answering.getpeercert(binary_form=True)


def test_certificates_that_a_robot_signed_count_for_no_robot(tmp_path: Path) -> None:
    server = make_certificates(tmp_path / "server")
    robot = make_certificates(tmp_path / "robot", authority="robot")
    robots = Robots(tmp_path / "robots")
    public = Ed25519PrivateKey.generate().public_key()
    key = public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    robots.add("arm1", key, robot.ca.read_bytes())
    tls = ServerTls(str(server.certificate), str(server.key), robots)
    tls.reload()
    shown = _shown(tls, robot, server)
    assert shown == ssl.PEM_cert_to_DER_cert(robot.certificate.read_text())
    assert tls.owner(shown) is None
    own = ssl.PEM_cert_to_DER_cert(robot.ca.read_text())
    assert tls.owner(own) == hashlib.sha256(own).hexdigest()
    assert tls.owner(None) is None
    robots.remove("arm1")
    tls.reload()
    assert tls.owner(own) is None
