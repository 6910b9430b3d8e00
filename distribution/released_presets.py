"""Keep the present presets as released versions, so that later versions recognise guards that were made from them.

`python -m distribution.released_presets` before a release, which checks it (`--check`).
"""

import sys
from collections.abc import Iterator, Sequence
from itertools import product

from appliance.features.guards.presets import PRESETS, Guard, Preset, text_of, types_in
from appliance.features.guards.released import FOLDER, hash_of


def lines_of(preset: Preset) -> Iterator[str]:
    """Yield the lines of `texts.sha256` for the present version of a preset."""
    all_types = [dict(zip(preset.topics, kinds, strict=True)) for kinds in product(*preset.topics.values())]
    texts = [preset.text, *(text_of(Guard(preset.name, preset, types=types)) for types in all_types)]
    for text in texts:
        pairs = " ".join(f"{topic}={kind}" for topic, kind in types_in(text).items())
        yield f"{hash_of(text, preset)} {preset.name} {preset.version} {pairs}"


def missing() -> list[str]:
    """Return the presets whose present version is not kept as a released one."""
    kept = (FOLDER / "texts.sha256").read_text(encoding="ascii").splitlines()
    return [preset.name for preset in PRESETS.values() if not {*lines_of(preset)} <= {*kept}]


def main(arguments: Sequence[str]) -> None:
    if arguments == ["--check"]:
        if names := missing():
            sys.exit(
                f"{', '.join(names)}: run python -m distribution.released_presets, and commit what it writes"
            )
        return
    table = FOLDER / "texts.sha256"
    lines = table.read_text(encoding="ascii").splitlines()
    for preset in PRESETS.values():
        path = FOLDER / f"{preset.name}-{preset.version}.rv"
        if path.exists() and path.read_text(encoding="utf-8") != preset.text:
            sys.exit(
                f"{path} is released: give the changed preset {preset.name} another version in its first line"
            )
        path.write_text(preset.text, encoding="utf-8")
        lines += [line for line in dict.fromkeys(lines_of(preset)) if line not in lines]
    table.write_text("\n".join(lines) + "\n", encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1:])
