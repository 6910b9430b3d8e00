import hashlib
import json
import subprocess
from pathlib import Path

import pytest

from distribution.release import main, release

pytestmark = pytest.mark.nightly


@pytest.fixture
def released(tmp_path: Path) -> Path:
    folder = tmp_path / "dist"
    folder.mkdir()
    (folder / "rosrv_0.2.0_amd64.deb").write_bytes(b"a package")
    (folder / "rosrv-image_0.2.0_amd64.tar").write_bytes(b"an image")
    key = tmp_path / "key.pem"
    for command in (
        ("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", str(key)),
        ("pkey", "-in", str(key), "-pubout", "-out", str(tmp_path / "public.pem")),
    ):
        subprocess.run(["openssl", *command], check=True, capture_output=True)
    release(folder, key)
    return folder


def checks(folder: Path) -> bool:
    signature = folder.parent / "signature"
    decoded = subprocess.run(
        ["base64", "--decode", "SHA256SUMS.sig"], cwd=folder, capture_output=True, check=False
    )
    if decoded.returncode:
        return False
    signature.write_bytes(decoded.stdout)
    verify = [
        "openssl",
        "dgst",
        "-sha256",
        "-verify",
        str(folder.parent / "public.pem"),
        "-signature",
        str(signature),
    ]
    sums = ["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"]
    return all(
        subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0
        for command in ([*verify, "SHA256SUMS"], sums)
    )


def test_standard_tools_check_it(released: Path) -> None:
    assert checks(released)


@pytest.mark.parametrize("name", ["rosrv_0.2.0_amd64.deb", "provenance.json", "SHA256SUMS", "SHA256SUMS.sig"])
def test_changes_are_found(released: Path, name: str) -> None:
    changed = bytearray((released / name).read_bytes())
    changed[5] ^= 1
    (released / name).write_bytes(changed)
    assert not checks(released)


def test_the_provenance_names_files_and_sources(released: Path) -> None:
    statement = json.loads((released / "provenance.json").read_text())
    assert statement["_type"] == "https://in-toto.io/Statement/v1"
    assert {one["name"]: one["digest"]["sha256"] for one in statement["subject"]} == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in released.glob("rosrv*")
    }
    sources = {
        resolvedDependency["name"]: resolvedDependency["digest"]
        for resolvedDependency in statement["predicate"]["buildDefinition"]["resolvedDependencies"]
    }
    assert len(sources["rosrv"]["gitCommit"].partition("-")[0]) == 40
    assert "requirements.lock" in sources


def test_another_kind_of_key_is_rejected(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.pem"
    subprocess.run(
        ["openssl", "genpkey", "-algorithm", "ed25519", "-out", str(other)], check=True, capture_output=True
    )
    with pytest.raises(ValueError, match="P-256"):
        release(released, other)
    assert main([]) == 2
    assert "KEY=FILE" in capsys.readouterr().err
