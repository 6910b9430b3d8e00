"""Robots in the data folder of a collector."""

from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from rosrv_fleet.robots import Robots

from appliance.signing.own_certificate import make_own_certificate


def enrolled_robots(data: Path, *names: str) -> Robots:
    """Enrol robots with keys of their own; return all robots."""
    robots = Robots(data / "robots")
    for name in names:
        public = Ed25519PrivateKey.generate().public_key()
        key = public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        robots.add(name, key, make_own_certificate(name, 1)[1])
    return robots
