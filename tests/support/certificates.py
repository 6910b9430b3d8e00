import datetime
import ipaddress
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from cryptography.x509.oid import NameOID


@dataclass(frozen=True)
class Certificates:
    ca: Path
    certificate: Path
    key: Path


def make_certificates(
    folder: Path, address: str = "127.0.0.1", authority: str = "test authority"
) -> Certificates:
    folder.mkdir(parents=True)
    keys = {name: ec.generate_private_key(ec.SECP256R1()) for name in ("ca", "peer")}
    issuer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, authority)])

    def made(name: str, subject: x509.Name, extensions: list[Any]) -> Path:
        builder = x509.CertificateBuilder(
            issuer,
            subject,
            keys[name].public_key(),
            x509.random_serial_number(),
            datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC),  # valid by any clock of a test
            datetime.datetime(2100, 1, 1, tzinfo=datetime.UTC),
        )
        for extension, critical in extensions:
            builder = builder.add_extension(extension, critical)
        file = folder / f"{name}.pem"
        file.write_bytes(builder.sign(keys["ca"], hashes.SHA256()).public_bytes(Encoding.PEM))
        return file

    usage = x509.KeyUsage(*[True] * 1, *[False] * 4, *[True] * 2, *[False] * 2)
    ca = made("ca", issuer, [(x509.BasicConstraints(True, None), True), (usage, True)])
    names = x509.SubjectAlternativeName(
        [x509.IPAddress(ipaddress.ip_address(address)), x509.DNSName("logs.example")]
    )
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "peer")])
    certificate = made("peer", subject, [(names, False)])
    key = folder / "peer.key"
    key.write_bytes(keys["peer"].private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return Certificates(ca, certificate, key)


def self_signed(file: Path, address: str, begin: datetime.datetime, end: datetime.datetime) -> Path:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rosrv")])
    made = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number(), begin, end)
    made = made.add_extension(
        x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), False
    )
    made = made.add_extension(x509.BasicConstraints(ca=True, path_length=0), True)
    file.write_bytes(made.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM))
    pair = file.with_suffix(".key")
    pair.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return pair


def own_certificate_until(end: bytes) -> bytes:
    key = ed25519.Ed25519PrivateKey.generate()
    algorithm = _der(0x30, bytes.fromhex("06032b6570"))
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "own")]).public_bytes()
    public = key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    validity = _der(0x30, b"\x17\x0d260101000000Z", end)
    signed = _der(0x30, bytes.fromhex("a003020102020101"), algorithm, name, validity, name, public)
    return ssl.DER_cert_to_PEM_cert(
        _der(0x30, signed, algorithm, _der(0x03, b"\0", key.sign(signed)))
    ).encode()


def _der(tag: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    size = bytes([len(body)]) if len(body) < 128 else bytes([0x81, len(body)])
    return bytes([tag]) + size + body
