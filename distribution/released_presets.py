"""Keep the present presets as released versions, so that later versions recognise guards that were made from them.

`python -m distribution.released_presets` before a release, which checks it (`--check`).
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from appliance.features.guards.presets import PRESETS, Preset
from appliance.features.guards.released import FOLDER


def missing() -> list[str]:
    """Return the presets whose present version is not kept as a released one."""
    return [preset.name for preset in PRESETS.values() if not _path(preset).exists()]


def _path(preset: Preset) -> Path:
    return FOLDER / f"{preset.name}-{preset.version}.rv"


def main(arguments: Sequence[str]) -> None:
    for preset in PRESETS.values():
        path = _path(preset)
        if path.exists() and path.read_text(encoding="utf-8") != preset.text:
            sys.exit(
                f"{path} is released: give the changed preset {preset.name} another version in its first line"
            )
    if arguments != ["--check"]:
        for preset in PRESETS.values():
            _path(preset).write_text(preset.text, encoding="utf-8")
    elif names := missing():
        sys.exit(
            f"{', '.join(names)}: run python -m distribution.released_presets, and commit what it writes"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
