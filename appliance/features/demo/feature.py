"""Define the tool demo."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Tool

FEATURE = Tool(verbs={"demo": Verb("appliance.features.demo.demo:demo", after="selftest")})
