"""Two ways of the robot from above, as `rosrv demo --output` saw them: `python -m examples.landshark.ways WAYS SVG`.

WAYS is a JSON file, `{"without": [[x, y], ...], "guarded": [[x, y], ...]}` in metres. With `cut` and `stopped`, it also
has the paths of a robot whose link is cut.
"""

import argparse
import json
from pathlib import Path

from examples.landshark.nodes import physics
from examples.landshark.picture import draw_ways


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("ways", type=Path)
    parser.add_argument("svg", type=Path)
    options = parser.parse_args()
    ways = json.loads(options.ways.read_text(encoding="utf-8"))
    paths = {name: [physics.Pose(x, y) for x, y in way] for name, way in ways.items()}
    options.svg.write_text(draw_ways(**paths), encoding="utf-8")


if __name__ == "__main__":
    main()
