"""The role that each request over REST needs. What changes something is `admin.RestChange`."""

from appliance.channel import admin

RANKS = {"viewer": 1, "operator": 2, "admin": 3}
_ADMINS = (
    admin.PolicyLoad, admin.MonitorLoad, admin.MonitorReplace, admin.MonitorRemove, admin.HostAdd, admin.HostToken,
    admin.HostRenew, admin.HostRevoke, admin.TokenList, admin.TokenRevoke,
)  # fmt: skip
_OPERATORS = (
    admin.PolicyReload, admin.PolicyRollback, admin.PolicyConfirm, admin.MonitorReload, admin.MonitorSwitch,
    admin.MonitorResume, admin.HostKit, admin.HostPorts, admin.HostsReload,
)  # fmt: skip
_VIEWERS = (
    admin.StatusWanted, admin.InventoryWanted, admin.PolicyWanted, admin.PolicyRevisions, admin.RegistrationsWanted,
    admin.GraphWanted, admin.MonitorsWanted, admin.HostList, admin.HostEndpoint, admin.ChallengeWanted,
)  # fmt: skip
# What the api counts by itself; what a host asks with its one-time token or its key; what is public.
_NOBODYS = (
    admin.MetricsWanted, admin.HostEnrol, admin.HostRenewItself, admin.HostRenewed, admin.RevocationsWanted,
    admin.AuthorityWanted,
)  # fmt: skip


def role_for(request: admin.RestRequest) -> str | None:
    """The least role of a token that may ask this; None where no token is needed."""
    if isinstance(request, admin.MonitorReload) and request.prune:
        return "admin"  # removes what an admin loaded
    if isinstance(request, _NOBODYS):
        return None
    if isinstance(request, _VIEWERS):
        return "viewer"
    return "operator" if isinstance(request, _OPERATORS) else "admin"
