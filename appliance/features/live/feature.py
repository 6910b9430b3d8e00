"""The feature live: `GET /v1/live`, `/v1/history` and `/v1/whoami`, which the console reads."""

from appliance.features.feature import Feature

LIVE = Feature("live", routes="appliance.features.live.live:routes")
