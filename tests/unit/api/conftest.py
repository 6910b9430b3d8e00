"""Fixtures for the tests of the REST contract."""

import asyncio

import pytest
from fastapi import FastAPI

from appliance.api.access import TokenAuthenticator
from appliance.api.app import build_app
from appliance.api.control import ControlLink
from appliance.api.history import SampleHistory
from appliance.api.journal import Journal
from appliance.api.services import Services
from appliance.channel.answers.measures import Measures
from appliance.configuration.settings import Settings
from tests.support.answers import example


@pytest.fixture(scope="module")
def app() -> FastAPI:
    async def nothing() -> Measures:
        return example(Measures)

    control, journal = ControlLink(lambda _tokens: None, lambda: None), Journal(lambda _call: None)
    return build_app(
        Services(
            Settings(), control, TokenAuthenticator(1, lambda _token: None), journal, asyncio.Event(),
            SampleHistory(nothing),
        )
    )  # fmt: skip
