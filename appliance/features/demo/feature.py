"""Define the feature demo."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

DEMO = Feature("demo", verbs={"demo": Verb("appliance.features.demo.demo:demo", after="selftest")})
