import pytest

from appliance.cli.meanings import is_reading
from tests.support.command import table
from tests.support.rows import require_rows
from tests.support.twice import TWICE


@pytest.mark.complete
def test_each_command_with_an_effect_says_what_a_second_one_does() -> None:
    acting = {name for name, _verb in table() if not is_reading(name)}
    require_rows(
        acting, set(TWICE), "TWICE of tests/support/twice.py, or READING of appliance/cli/meanings.py"
    )
