"""At which address hosts reach the appliance where whoever enrols them does not say it."""

import asyncio
from collections.abc import Awaitable, Callable

from appliance.channel.answers.host_answers import Endpoint
from appliance.channel.messages import EndpointFound
from appliance.configuration.settings import Settings
from appliance.hosts.host_table import HostRefusedError
from appliance.hosts.rest_place import NO_TUNNELS

_PATIENCE_SECONDS = 20.0


async def find_endpoint(settings: Settings, look: Callable[[], Awaitable[EndpointFound]]) -> Endpoint:
    """What is configured, else what the supervisor sees.

    Raises `HostRefusedError`, which says what to give instead.
    """
    if settings.isolation == "none":
        raise HostRefusedError(NO_TUNNELS)
    configured = settings.ipsec.endpoint
    if configured is not None:
        return Endpoint(configured, "ipsec.endpoint of the configuration")
    try:
        found = await asyncio.wait_for(look(), _PATIENCE_SECONDS)
    except TimeoutError:
        raise HostRefusedError("the supervisor did not answer: try again", ours=True) from None
    if found.address is None:
        raise HostRefusedError(
            f"at which address the host reaches the appliance cannot be told: {found.reason}; give it:"
            " --appliance ADDRESS (REST: `endpoint`), or for all hosts `ipsec: {endpoint: ADDRESS}` in appliance.yaml"
            " (compose: ROSRV_ENDPOINT=ADDRESS in .env)"
        )
    return Endpoint(found.address, found.reason)
