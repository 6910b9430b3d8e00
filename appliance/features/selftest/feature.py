"""Define the feature selftest."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

SELFTEST = Feature(
    "selftest",
    verbs={"selftest": Verb("appliance.features.selftest.verb:selftest", after="limits")},
)
