"""The interface that the tests of its contract look at."""

import asyncio

import pytest
from fastapi import FastAPI

from appliance.api.access import Doorkeeper
from appliance.api.app import build_app
from appliance.api.control import ControlLink
from appliance.api.history import History
from appliance.api.journal import Journal
from appliance.api.services import Services
from appliance.channel.answers.measures import Measures
from appliance.configuration.settings import Settings
from tests.support.answers import example


@pytest.fixture(scope="module")
def app() -> FastAPI:
    """The interface, of an appliance that says nothing."""

    async def nothing() -> Measures:
        return example(Measures)

    control, journal = ControlLink(lambda _tokens: None, lambda: None), Journal(lambda _call: None)
    return build_app(Services(Settings(), control, Doorkeeper(1), journal, asyncio.Event(), History(nothing)))
