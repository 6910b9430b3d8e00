"""Define the feature metrics. Control measures; `metric_table.py` has the names."""

from appliance.features.feature import Feature

METRICS = Feature("metrics", routes="appliance.features.metrics.metrics_route:routes")
