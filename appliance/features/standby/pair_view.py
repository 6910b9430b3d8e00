"""The metrics of two appliances."""

from collections.abc import Mapping

from appliance.features.standby.answers import StandbyState
from appliance.features.standby.requests import StandbyWanted
from appliance.features.standby.view import samples_of
from appliance.features.view import PairView, Samples


class StandbyPairView(PairView):
    """The passive appliance of a pair."""

    def request(self) -> StandbyWanted:
        return StandbyWanted()

    def samples(self, state: StandbyState) -> Mapping[str, Samples]:
        return samples_of(state)
