"""Define the tool live."""

from appliance.features.feature import Tool

FEATURE = Tool()
