"""The views of the standby."""

from appliance.features.view import FeatureView

STANDBY_VIEW = FeatureView("standby", pair="appliance.features.standby.pair_view:StandbyPairView")
