import json
from pathlib import Path

import jsonschema_rs
import pytest
import yaml

from tests.support.command import rosrv


def test_the_schema_accepts_only_known_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    schema = jsonschema_rs.validator_for(json.loads(rosrv("config", "show", "--schema").stdout))
    assert schema.is_valid(yaml.safe_load(rosrv("config", "show").stdout))
    assert not schema.is_valid({"listn": "x"})
