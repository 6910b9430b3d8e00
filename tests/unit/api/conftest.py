import pytest
from fastapi import FastAPI

from tests.support.rest_world import idle_application


@pytest.fixture(scope="module")
def app() -> FastAPI:
    return idle_application()
