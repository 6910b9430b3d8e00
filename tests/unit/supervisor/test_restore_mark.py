from pathlib import Path

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored, set_mark


def test_a_marked_directory_is_refused(tmp_path: Path) -> None:
    refuse_half_restored(tmp_path)
    mark = set_mark(tmp_path)
    with pytest.raises(StartError, match="remove this folder, and run `rosrv restore` again"):
        refuse_half_restored(tmp_path)
    with pytest.raises(FileExistsError):
        set_mark(tmp_path)
    mark.unlink()
    refuse_half_restored(tmp_path)


def test_a_missing_directory_is_not_marked(tmp_path: Path) -> None:
    refuse_half_restored(tmp_path / "new")
