from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.features.adopt.adopt_record import FILE, AdoptRecord, Phase, boot_id, save_record


@pytest.mark.parametrize("boot", [boot_id(), "earlier"], ids=["this boot", "an earlier one"])
@pytest.mark.parametrize("phase", [*Phase, None])
def test_only_a_state_that_no_release_needs_is_erased(tmp_path: Path, phase: Phase | None, boot: str) -> None:
    """None is a record that cannot be read: a release takes it for an adopted graph."""
    state = tmp_path / "state"
    save_record(state, AdoptRecord(wanted=True, phase=phase or Phase.TAKEN, boot=boot))
    if phase is None:
        (state / FILE).write_text("{")
    needed = phase is None or (phase is not Phase.FREE and boot == boot_id())
    done = CliRunner().invoke(app, ["purge", "--state", str(state), "--yes"])
    assert (done.exit_code, state.exists()) == (int(needed), needed), done.output
    assert ("release --dead" in done.output.replace("\n", " ")) is needed
