import pkgutil
import re
from pathlib import Path

import pytest

from appliance.configuration.config_sources import ConfigError, resolve
from appliance.configuration.sections import Sections
from appliance.features.recorder.feature import FEATURE
from appliance.features.recorder.rings import USED_BY
from appliance.features.recorder.settings import RecorderRules
from appliance.supervisor.roles import ROLES, roles_of

BY_NAME = {role.name: role for role in ROLES}


def test_the_recorder_runs_only_if_configured() -> None:
    recorder = BY_NAME["recorder"]
    assert recorder in roles_of(sections=Sections({RecorderRules: RecorderRules(enabled=True)}))
    assert recorder not in roles_of()
    assert recorder.user not in {role.user for role in ROLES if role is not recorder}
    assert recorder.group == recorder.readable_by == BY_NAME["api"].user
    assert (recorder.dispensable, recorder.network, recorder.capabilities) == (True, False, ())


def test_each_function_that_is_named_exists() -> None:
    assert all(
        callable(pkgutil.resolve_name(place))
        for place in (*filter(None, [role.memory for role in FEATURE.roles]), USED_BY)
    )


def test_a_similar_key_of_the_section_is_proposed(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text("recorder: {enable: true}\n")  # `enable` is a key of its own, but `enabled` is nearer
    with pytest.raises(ConfigError, match=re.escape("unknown key recorder.enable: did you mean enabled?")):
        resolve(file, {}, {})
