import ssl
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.robots import Robots

from appliance.signing.own_certificate import make_own_certificate


def enrolled_robots(data: Path, *names: str) -> Robots:
    robots = Robots(data / "robots")
    for name in names:
        public = Ed25519PrivateKey.generate().public_key()
        key = public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        robots.add(name, key, make_own_certificate(name, 1)[1])
    return robots


class JoiningAppliance:
    def __init__(self) -> None:
        public = Ed25519PrivateKey.generate().public_key()
        self.raw = public.public_bytes_raw()
        self.key = public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        self.certificate = make_own_certificate("arm7", 1)[1]

    def join(self, robots: Robots, appliance: str = "") -> Robot:
        return robots.join("arm7", self.key, self.certificate, "", appliance)

    def of(self, robots: Robots) -> str:
        der = ssl.PEM_cert_to_DER_cert(self.certificate.decode())
        robot = robots.with_certificate(der)
        return "" if robot is None else f"{robot.name}/{robot.appliance_with(der)}"
