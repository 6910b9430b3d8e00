"""The feature selftest: `rosrv selftest` checks a fresh machine, or a running appliance."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

SELFTEST = Feature(
    "selftest",
    verbs={"selftest": Verb("appliance.features.selftest.verb:selftest", after="limits")},
)
