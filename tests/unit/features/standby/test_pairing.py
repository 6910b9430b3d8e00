import json
from contextlib import closing
from pathlib import Path

import pytest

from appliance.features.standby.membership import LINK_FILE, path_of, save_membership
from appliance.features.table import pairing_in
from appliance.supervisor.errors import StartError
from appliance.supervisor.roles import roles_of
from appliance.supervisor.state_directory import StateDirectory, foreign
from tests.support.features.standby.standby_site import memberships


@pytest.fixture
def state(tmp_path: Path) -> Path:
    made, *_settings = memberships(tmp_path / "made")
    save_membership(path_of(tmp_path / "state"), made["a"])
    return tmp_path / "state"


def test_each_process_gets_its_own_secrets(state: Path) -> None:
    pairing = pairing_in(state)
    assert pairing is not None
    lease, link = (json.loads(contents) for _name, _user, contents in pairing.files)
    assert lease["witness_key"] and lease["peer_key"] and not lease["key"]
    assert link["key"] and not link["witness_key"] and not link["peer_key"]
    assert (pairing.robot, pairing.other) == (link["witness"], link["other_address"])
    extra = {role.name for role in roles_of(paired=True)} - {role.name for role in roles_of()}
    assert extra == {"lease"}


def test_files_of_a_pair_end_with_the_pair(state: Path) -> None:
    assert foreign(state) is None
    link = state / "run" / LINK_FILE
    with closing(StateDirectory(state)) as directory:
        directory.prepare(())
        pairing = pairing_in(state)
        assert pairing is not None
        directory.write_files(pairing.files)
        assert link.stat().st_mode & 0o777 == 0o600
        path_of(state).unlink()
        directory.write_files(())
        assert not link.exists()
    assert pairing_in(state) is None


def test_a_damaged_membership_stops_the_start(state: Path) -> None:
    pairing = pairing_in(state)
    assert pairing is not None
    assert "end the pair first" in pairing.fixed_authority
    path_of(state).write_text("{}")
    with pytest.raises(StartError, match=r"membership\.json cannot be used: .*rosrv standby leave"):
        pairing_in(state)
