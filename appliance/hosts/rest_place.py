"""Where other machines and hosts in tunnels reach REST, as far as the configuration says. No I/O."""

from dataclasses import dataclass

from appliance.configuration.settings import Settings, is_loopback

NO_TUNNELS = (
    "isolation: none has no tunnels, for no firewall keeps their addresses from being forged: start the appliance with"
    " `isolation: netns` or `container`"
)


@dataclass(frozen=True)
class RestPlace:
    """`port` is that for other machines; None: they cannot reach it, and `trouble` says what to do.

    `inner_port` is that for hosts in their tunnels, at the appliance's own address there; None: they cannot.
    """

    port: int | None
    trouble: str
    inner_port: int | None


def rest_place(settings: Settings) -> RestPlace:
    """The place."""
    if settings.isolation == "none":
        return RestPlace(None, NO_TUNNELS, None)
    if settings.api_address is None:
        return RestPlace(None, "REST is off: hosts cannot enrol themselves; set `api: 0.0.0.0:8443`", None)
    host, port = settings.api_address
    if not settings.api_tls:
        return RestPlace(None, "REST is in clear text (api_tls: off): hosts cannot enrol themselves", None)
    everywhere = settings.isolation == "netns" or host in ("0.0.0.0", "::")  # noqa: S104  compared only
    inner = port if everywhere else None
    trouble = _trouble_outside(settings, host, port, everywhere=everywhere)
    return RestPlace(None if trouble else port, trouble, inner)


def _trouble_outside(settings: Settings, host: str, port: int, *, everywhere: bool) -> str:
    """Why other machines cannot reach it, and what to do; empty where they can."""
    if not everywhere and is_loopback(host):
        return f"REST listens on {host} only: for hosts to enrol themselves set `api: 0.0.0.0:{port}`"
    if not settings.api_published:
        return (
            "other machines cannot reach REST (api_published: off). For hosts to enrol themselves publish port"
            f" {port} of the container on an address of this machine, name their network in ROSRV_API_NETWORKS, and set"
            " ROSRV_API_PUBLISHED (docs/enrol-a-laptop.md); a kit, without --token, needs none of it"
        )
    if not settings.api_networks:
        return (
            "only this machine may connect to REST: set `api_networks` to the network from which hosts enrol"
            " themselves, such as [192.168.1.0/24]"
        )
    return ""
