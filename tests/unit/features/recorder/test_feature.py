import pkgutil

from appliance.configuration.sections import Sections
from appliance.features.recorder.feature import RECORDER
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
    named = [RECORDER.routes, RECORDER.recorded, USED_BY]
    assert all(callable(pkgutil.resolve_name(str(place))) for place in named)
