from collections.abc import Iterator

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest


@pytest.fixture(scope="module")
def running() -> Iterator[Appliance]:
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


@pytest.fixture(scope="module")
def rest(running: Appliance) -> Rest:
    return running.rest()
