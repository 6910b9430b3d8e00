import os

import pytest
import typer

from appliance.cli.audit.audit_errors import Errors


@pytest.mark.parametrize(("errors", "status"), [(Errors(), 0), (Errors(unread=1), 1)])
def test_a_reader_that_ends_is_an_error_only_for_a_verb_that_should_go_on(
    errors: Errors, status: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    del capfd  # gives standard output a descriptor
    monkeypatch.setattr(os, "dup2", lambda *_descriptors: None)
    with pytest.raises(typer.Exit) as ended, errors:
        raise BrokenPipeError
    assert ended.value.exit_code == status
