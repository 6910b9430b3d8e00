"""What the api may ask in whose name: held against the tokens that control itself keeps.

The api has recognised the token already. It is asked again here by name and role, because the api is the process that
browsers talk to: one that has fallen to a stranger can say any name, but no change is made in a name that no token
has, or for a role that no token has.
"""

from collections.abc import Iterable

from appliance.channel import admin
from appliance.channel.messages import TokenKept

_RANKS = {"viewer": 1, "operator": 2, "admin": 3}
_ADMINS = (
    admin.PolicyLoad, admin.MonitorLoad, admin.MonitorRemove, admin.HostAdd, admin.HostToken, admin.HostRenew,
    admin.HostRevoke, admin.TokenList, admin.TokenRevoke,
)  # fmt: skip
_OPERATORS = (
    admin.PolicyReload, admin.PolicyRollback, admin.PolicyConfirm, admin.MonitorReload, admin.MonitorSwitch,
    admin.MonitorResume, admin.HostKit, admin.HostPorts, admin.HostsReload,
)  # fmt: skip


def obstacle(request: admin.RestRequest, who: str, tokens: Iterable[TokenKept]) -> str | None:
    """Why this is not done in the name of `who`; None when a token that can be used may ask it.

    Looking, and what a host asks for itself with its one-time token or its key, need no token here.
    """
    role = (
        "admin" if isinstance(request, _ADMINS) else "operator" if isinstance(request, _OPERATORS) else None
    )
    if role is None:
        return None
    if any(one.name == who and _RANKS[one.role] >= _RANKS[role] for one in tokens):
        return None
    return f"no token {who[:80]!r} that can be used is {'an' if role[0] in 'ao' else 'a'} {role}'s"
