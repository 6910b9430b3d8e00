"""The feature demo: `rosrv demo` runs the example of a simulated robot."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

DEMO = Feature("demo", verbs={"demo": Verb("appliance.features.demo.demo:demo", after="selftest")})
