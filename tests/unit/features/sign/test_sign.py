import json
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    KeySerializationEncryption,
    NoEncryption,
    PrivateFormat,
)
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.signing.site_keys import signer
from tests.support.site_key import KEY, LINE, NAME

PLAIN = NoEncryption()


def written(
    folder: Path, form: PrivateFormat = PrivateFormat.OpenSSH, encryption: KeySerializationEncryption = PLAIN
) -> Path:
    file = folder / "site"
    file.write_bytes(KEY.private_bytes(Encoding.PEM, form, encryption))
    return file


def sign(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["sign", *map(str, arguments)])
    return done.exit_code, done.output


@pytest.mark.parametrize("form", [PrivateFormat.OpenSSH, PrivateFormat.PKCS8])
def test_each_file_gets_a_signature_beside_it(tmp_path: Path, form: PrivateFormat) -> None:
    files = [tmp_path / "p.ini", tmp_path / "a.rv"]
    for file in files:
        file.write_text(f"{file.name} ä\n", encoding="utf-8")
    status, said = sign(*files, "--key", written(tmp_path, form), "--json")
    told = [json.loads(line) for line in said.splitlines()]
    assert status == 0
    assert [one["signature"] for one in told] == [f"{file}.sig" for file in files]
    for file in files:
        signature = Path(f"{file}.sig").read_text(encoding="ascii")
        assert signer([f"{told[0]['key']} site 2026"], file.read_text(encoding="utf-8"), signature) == NAME
    assert LINE.startswith(told[0]["key"])


@pytest.mark.parametrize(
    ("content", "why"),
    [(b"a\r\n", "CR LF"), (b"\xef\xbb\xbfa\n", "byte order mark"), (b"\xff\n", "not UTF-8")],
)
def test_ambiguous_text_is_not_signed(tmp_path: Path, content: bytes, why: str) -> None:
    good, bad = tmp_path / "a.rv", tmp_path / "b.rv"
    good.write_text("a\n")
    bad.write_bytes(content)
    status, said = sign(good, bad, "--key", written(tmp_path))
    assert (status, list(tmp_path.glob("*.sig"))) == (2, [])
    assert why in said


def test_a_key_that_cannot_sign_is_an_error_with_advice(tmp_path: Path) -> None:
    file = tmp_path / "p.ini"
    file.write_text("[Nodes]\n")
    locked = written(tmp_path, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
    assert f"ssh-keygen -Y sign -n rosrv -f {locked} FILE" in sign(file, "--key", locked)[1]
    other = tmp_path / "ec"
    other.write_bytes(
        generate_private_key(SECP256R1()).private_bytes(Encoding.PEM, PrivateFormat.PKCS8, PLAIN)
    )
    assert sign(file, "--key", other) == (
        2,
        f"rosrv sign: {other} is not a private Ed25519 key; create one: ssh-keygen -t ed25519 -f KEY\n",
    )
    assert "cannot read" in sign(file, "--key", tmp_path / "nothing")[1]
