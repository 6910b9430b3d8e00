"""Define the feature tunnels."""

from appliance.cli.verb_table import FIRST, Group, Verb
from appliance.features.feature import ConsolePart, Feature
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

_PLACE = "appliance.features.tunnels."


FEATURE = Feature(
    roles=(
        Role(
            "charon", "rosrv-ipsec", "ipsec", f"{_PLACE}process:main",
            path=lambda facts: facts.part("ipsec"), links=("control",), dispensable=True, on_demand=True,
            capabilities=("NET_ADMIN", "NET_BIND_SERVICE"),
            sandbox=lambda _facts: SandboxPlan(
                families=ROUTES,
                programs=("/usr", "/lib", "/lib64"),
                writes=("/dev/net", "/proc/sys/net"),
            ),
        ),
    ),
    console=(
        ConsolePart("view", "view.js", "Hosts", "Hosts"),
        ConsolePart("search", "search.js", "hosts", "Enrolled hosts"),
    ),
    verbs={
        "protect": Verb(
            f"{_PLACE}protect_verb:protect",
            "Close the ROS ports of this machine to all but the appliance.",
            after="alarm",
        ),
        "host": Group(
            "Block hosts; enrol, list and revoke hosts that connect through IPsec tunnels.",
            {
                "add": Verb(f"{_PLACE}host_verbs:add", after=FIRST),
                "authority": Group(
                    "Replace the certificate authority of hosts.",
                    {"rotate": Verb(f"{_PLACE}authority_verb:rotate")},
                    after="add",
                ),
                "kit": Verb(f"{_PLACE}host_verbs:kit", after="blocks"),
                "list": Verb(f"{_PLACE}host_verbs:list_hosts", after="kit"),
                "reload": Verb(f"{_PLACE}host_verbs:reload", after="list"),
                "revoke": Verb(f"{_PLACE}host_verbs:revoke", after="reload"),
            },
        ),
    },
)  # fmt: skip
