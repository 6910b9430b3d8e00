from contextlib import closing
from pathlib import Path

import pytest

from appliance.backup.contents import BackupError
from appliance.features.tunnels.authority_verb import rotate_authority
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.supervisor.service_gate import Pairing
from appliance.supervisor.state_directory import StateDirectory
from tests.support.idle import idle, replace


@pytest.fixture
def state(tmp_path: Path) -> Path:
    StateDirectory(tmp_path).close()
    (tmp_path / "signer").mkdir(mode=0o700)
    CertificateAuthority(tmp_path / "signer").revocations([])
    (tmp_path / "signer" / "key").write_text("of the log")
    return tmp_path


def test_the_next_start_has_another_authority(state: Path) -> None:
    before = CertificateAuthority(state / "signer").certificate
    number = int((state / "signer" / "ca.list").read_text())
    key = (state / "signer" / "ca.key").open("rb")
    secret = key.read()
    rotate_authority(state)
    with key:
        key.seek(0)
        assert key.read() != secret  # the blocks on the disk are overwritten
    after = CertificateAuthority(state / "signer")
    assert after.certificate != before
    after.revocations([])
    assert int((state / "signer" / "ca.list").read_text()) > number
    assert (state / "signer" / "key").read_text() == "of the log"


def test_it_needs_a_stopped_single_appliance_with_an_authority(state: Path, tmp_path: Path) -> None:
    before = CertificateAuthority(state / "signer").certificate
    with closing(StateDirectory(state)), pytest.raises(BackupError, match="stop the appliance first"):
        rotate_authority(state)
    assert CertificateAuthority(state / "signer").certificate == before
    rotate_authority(state)
    with pytest.raises(BackupError, match="no authority yet"):
        rotate_authority(state)
    with pytest.raises(BackupError, match="does not exist"):
        rotate_authority(state / "nowhere")


def test_one_of_two_appliances_keeps_its_authority(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = idle(Pairing)
    replace(pair, fixed_authority="end the pair first")
    monkeypatch.setattr("appliance.features.tunnels.authority_verb.pairing_in", lambda _state: pair)
    with pytest.raises(BackupError, match="end the pair first"):
        rotate_authority(state)
    assert (state / "signer" / "ca.key").exists()
