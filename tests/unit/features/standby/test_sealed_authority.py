from pathlib import Path

import pytest

from appliance.features.standby.first_join import SealedAuthority, keep_sealed, sealed_authority
from appliance.ipsec.brought_authority import FOLDER, open_authority
from appliance.ipsec.certificate_authority import KEY_FILE, CertificateAuthority

SECRET = b"correct horse"


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "a").mkdir()
    return tmp_path / "a", tmp_path / "b"


def joined(folders: tuple[Path, Path]) -> CertificateAuthority:
    made = CertificateAuthority(folders[0], passphrase=SECRET)
    sealed = sealed_authority(folders[0])
    assert sealed is not None
    keep_sealed(folders[1], sealed, None)
    return made


def test_a_clear_key_never_leaves(folders: tuple[Path, Path]) -> None:
    CertificateAuthority(folders[0])
    assert sealed_authority(folders[0]) is None
    clear = SealedAuthority("", (folders[0] / KEY_FILE).read_text())
    with pytest.raises(ValueError, match=r"not encrypted: set ipsec\.ca_passphrase_file"):
        keep_sealed(folders[1], clear, None)
    assert not folders[1].exists()


def test_the_passphrase_opens_it(folders: tuple[Path, Path]) -> None:
    made = joined(folders)
    assert (folders[1] / FOLDER / KEY_FILE).stat().st_mode & 0o777 == 0o600
    for _start in range(2):
        found, trouble = open_authority(folders[1], "ecdsa", SECRET)
        assert (found.certificate, trouble) == (made.certificate, "")


@pytest.mark.parametrize(
    ("secret", "reason"),
    [(None, "name the file that has its passphrase"), (b"battery", "the passphrase is wrong")],
)
def test_without_the_passphrase_it_waits(
    folders: tuple[Path, Path], secret: bytes | None, reason: str
) -> None:
    made = joined(folders)
    before = (folders[1] / FOLDER / KEY_FILE).read_bytes()
    found, trouble = open_authority(folders[1], "ecdsa", secret)
    assert found.certificate != made.certificate
    assert reason in trouble
    assert (folders[1] / FOLDER / KEY_FILE).read_bytes() == before


def test_a_clear_key_in_its_place_is_not_used(folders: tuple[Path, Path]) -> None:
    made = joined(folders)
    CertificateAuthority(folders[1])
    (folders[1] / FOLDER / KEY_FILE).write_bytes((folders[1] / KEY_FILE).read_bytes())
    found, trouble = open_authority(folders[1], "ecdsa", SECRET)
    assert found.certificate != made.certificate
    assert "the key is not encrypted, so it is not used" in trouble
