"""Define the feature adopt."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.adopt."


FEATURE = Feature(
    verbs={
        "adopt": Verb(f"{_PLACE}adopt_verb:adopt", after="survey"),
        "release": Verb(f"{_PLACE}release_verb:release", after="adopt"),
    },
)
