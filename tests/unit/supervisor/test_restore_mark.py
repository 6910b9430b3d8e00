"""Tests of the mark of a restore that did not come to its end."""

from pathlib import Path

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored, set_mark


def test_what_is_marked_is_refused(tmp_path: Path) -> None:
    """From the first moment to the last, in words that say what to do; a second restore cannot mark it, too."""
    refuse_half_restored(tmp_path)
    mark = set_mark(tmp_path)
    with pytest.raises(StartError, match="remove it, and `rosrv restore` once more"):
        refuse_half_restored(tmp_path)
    with pytest.raises(FileExistsError):
        set_mark(tmp_path)
    mark.unlink()
    refuse_half_restored(tmp_path)


def test_a_place_that_is_not_there_is_not_marked(tmp_path: Path) -> None:
    """Whoever starts an appliance on a new directory is not held up."""
    refuse_half_restored(tmp_path / "new")
