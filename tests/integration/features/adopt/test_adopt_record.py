from pathlib import Path

import pytest

from appliance.features.adopt.adopt_record import AdoptRecord, Phase, boot_id, load_record, save_record
from appliance.network.namespaces import NetworkError
from tests.support.small_disk import filled, small_disk


@pytest.mark.parametrize("phase", Phase)
def test_on_a_full_disk_a_graph_is_given_back_and_none_is_taken(tmp_path: Path, phase: Phase) -> None:
    with small_disk(tmp_path / "state", "1m") as state:
        earlier, later = AdoptRecord(boot=boot_id()), AdoptRecord(wanted=True, phase=phase, boot=boot_id())
        save_record(state, earlier)
        with filled(state):
            if phase is Phase.TAKING:
                with pytest.raises(NetworkError, match="cannot be written"):
                    save_record(state, later)
            else:
                save_record(state, later)
        assert load_record(state) == (earlier if phase is Phase.TAKING else later)
