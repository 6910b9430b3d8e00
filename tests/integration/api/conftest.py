"""A running appliance with REST, and a client for it that trusts the appliance's certificate."""

from collections.abc import Iterator

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest


@pytest.fixture(scope="module")
def running() -> Iterator[Appliance]:
    """An appliance of this module, with REST over TLS on a free port."""
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


@pytest.fixture(scope="module")
def rest(running: Appliance) -> Rest:
    """REST as the holder of the first token."""
    return running.rest()
