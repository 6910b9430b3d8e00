from appliance.features.guards.evidence import guard_digest, text_digest
from appliance.features.guards.presets import PRESETS, Guard, text_of

SPEED, SANE = PRESETS["speed"], PRESETS["sane"]


def test_a_digest_changes_with_preset_text_and_values() -> None:
    text = text_of(Guard("g", SPEED))
    whole = guard_digest(SPEED, text, {"vMax": "0.5", "wMax": "1"})
    assert whole == guard_digest(SPEED, text, {"wMax": "1", "vMax": "0.5"})
    others = (
        guard_digest(SANE, text, {"vMax": "0.5", "wMax": "1"}),
        guard_digest(SPEED, text + " ", {"vMax": "0.5", "wMax": "1"}),
        guard_digest(SPEED, text, {"vMax": "0.51", "wMax": "1"}),
        guard_digest(SPEED, text, {"vMax": "0.5"}),
    )
    assert len({whole, *others}) == 5


def test_presets_have_different_digests() -> None:
    digests = {text_digest(preset.text) for preset in PRESETS.values()}
    assert len(digests) == len(PRESETS) and all(len(digest) == 16 for digest in digests)
