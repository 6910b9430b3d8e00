"""The section `authority` of `appliance.yaml`."""

from typing import ClassVar

from appliance.configuration.sections import FeatureSection, key, section

TAKE, GIVE = "drive/take", "drive/give"


@section
class AuthoritySettings(FeatureSection):
    """How nodes take and give the groups of `[Authority]`."""

    place: ClassVar[str] = "authority"
    nodes_may_call: bool = key(
        default=False,
        description="offer the services /rosrv/drive/take and /rosrv/drive/give (std_srvs/Trigger) to nodes; the policy"
        " decides who may call them",
    )

    def services(self) -> tuple[str, ...]:
        return (TAKE, GIVE) if self.nodes_may_call else ()
