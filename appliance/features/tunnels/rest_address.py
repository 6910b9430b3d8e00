"""Derive from the configuration where other machines, and hosts in tunnels, reach REST. No I/O."""

from dataclasses import dataclass

from appliance.configuration.sections import is_loopback
from appliance.configuration.settings import Settings

NO_TUNNELS = (
    "isolation: none has no tunnels, because without a firewall their addresses can be forged: start the appliance with"
    " `isolation: netns` or `container`"
)


@dataclass(frozen=True)
class RestAddress:
    port: int | None
    """For other machines."""
    trouble: str
    """The reason and the remedy if there is no port for other machines."""
    inner_port: int | None
    """For hosts in tunnels, at the appliance's tunnel address."""


def rest_address(settings: Settings) -> RestAddress:
    if settings.isolation == "none":
        return RestAddress(None, NO_TUNNELS, None)
    if settings.api_address is None:
        return RestAddress(None, "REST is off: hosts cannot enrol themselves; set `api: 0.0.0.0:8443`", None)
    host, port = settings.api_address
    if not settings.api_tls:
        return RestAddress(None, "REST is in clear text (api_tls: off): hosts cannot enrol themselves", None)
    everywhere = settings.isolation == "netns" or host in ("0.0.0.0", "::")  # noqa: S104  compared only
    inner = port if everywhere else None
    trouble = _trouble_outside(settings, host, port, everywhere=everywhere)
    return RestAddress(None if trouble else port, trouble, inner)


def _trouble_outside(settings: Settings, host: str, port: int, *, everywhere: bool) -> str:
    if not everywhere and is_loopback(host):
        return f"REST listens on {host} only: for hosts to enrol themselves set `api: 0.0.0.0:{port}`"
    if not settings.api_published:
        return (
            "other machines cannot reach REST (api_published: off). For hosts to enrol themselves publish port"
            f" {port} of the container on an address of this machine, name their network in ROSRV_API_NETWORKS, and set"
            " ROSRV_API_PUBLISHED (docs/tunnels.md); a kit, without --token, needs no REST"
        )
    if not settings.api_networks:
        return (
            "only this machine may connect to REST: set `api_networks` to the network from which hosts enrol"
            " themselves, such as [192.168.1.0/24]"
        )
    return ""
