"""Define the feature live."""

from appliance.features.feature import Feature

LIVE = Feature("live", routes="appliance.features.live.live:routes")
