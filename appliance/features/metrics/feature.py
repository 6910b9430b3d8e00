"""Define the tool metrics. Control measures; `metric_table.py` has the names."""

from appliance.features.feature import Tool

FEATURE = Tool()
