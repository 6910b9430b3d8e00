"""Draw drives from above as an SVG: the yard, the obstacle, the robot's path, the shots, and the gun's angle.

The picture has its own background, so that it is also readable on a dark page.
"""

import html
from typing import TYPE_CHECKING

from examples.landshark.nodes import physics

if TYPE_CHECKING:
    from examples.landshark.drive import Drive

FENCE = 8.0  # metres, as in runaways.py
ZONE = 20.0  # metres, as in safe_zone.rv
LOWEST = -0.45  # radians, as in safe_triggering.rv
SCALE = 16.0  # pixels a metre
CENTRE = (355.0, 465.0)
BOTTOM = 640.0  # where the drawn part of the yard ends
STRIP = (70.0, 705.0, 890.0, 110.0)  # left, top, width, height of the gun's angle
WITHOUT, GUARDED = "#c2410c", "#1d4ed8"
STYLE = """
text { font: 14px system-ui, 'DejaVu Sans', sans-serif; fill: #1f2937 }
.title { font-size: 19px; font-weight: 600 }
.small { font-size: 12px; fill: #4b5563 }
.track { fill: none; stroke-width: 3; stroke-linejoin: round; stroke-linecap: round }
.without { stroke: #c2410c; stroke-dasharray: 7 6 }
.guarded { stroke: #1d4ed8 }
.leader { stroke: #6b7280; stroke-width: 1 }
"""


def draw(without: "Drive", guarded: "Drive") -> str:
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 860" role="img">',
        "<title>The LandShark's drive from above, without and with monitors</title>",
        f"<style>{STYLE}</style>",
        '<rect width="1000" height="860" fill="#ffffff"/>',
        _text(40, 44, "The same commands, without and with monitors", "title"),
        _yard(),
        _track(without.poses, "without"),
        _track(guarded.poses, "guarded"),
        *_ends(without, guarded),
        *_notes(without, guarded),
        _legend(),
        *_gun(guarded),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def draw_ways(
    without: list[physics.Pose],
    guarded: list[physics.Pose],
    cut: list[physics.Pose] | None = None,
    stopped: list[physics.Pose] | None = None,
) -> str:
    """Draw the paths of a robot, with `cut` and `stopped` also those of one whose link is cut."""
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 640" role="img">',
        "<title>The LandShark's ways from above, without and with monitors</title>",
        f"<style>{STYLE}</style>",
        '<rect width="1000" height="640" fill="#ffffff"/>',
        _text(40, 44, "The robot's ways, without and with monitors", "title"),
        _yard(),
        _track(without, "without"),
        _track(guarded, "guarded"),
        *(_end(way[-1], colour) for way, colour in ((without, WITHOUT), (guarded, GUARDED))),
        *(_cut(cut, stopped) if cut and stopped else ()),
        *_legend_of_ways(),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _cut(cut: list[physics.Pose], stopped: list[physics.Pose]) -> list[str]:
    left, top = _at(-FENCE, FENCE)
    size = 2 * FENCE * SCALE
    parts = [
        f'<rect x="{left}" y="{top}" width="{size}" height="{size}" fill="none" stroke="#7c3aed" '
        'stroke-dasharray="3 5"/>',
        _text(left + 6, top + 16, "fence", "small"),
    ]
    for way, kind, colour in ((cut, "without", WITHOUT), (stopped, "guarded", GUARDED)):
        (x, y), (end_x, end_y) = (_at(one.x, one.y) for one in (way[1], way[2]))
        up = -12 if kind == "without" else 20
        words = "link cut: it drives on" if kind == "without" else "link cut: deadman stops it here"
        parts += [
            _track(way, kind),
            _end(way[-1], colour),
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#b91c1c"/>',
            f'<path d="M{end_x:.1f} {end_y - 9:.1f}v18" stroke="{colour}" stroke-width="3"/>',
            _text(end_x, end_y + up, words, "small", "start" if kind == "without" else "end"),
        ]
    return parts


def _at(x: float, y: float) -> tuple[float, float]:
    return CENTRE[0] + x * SCALE, CENTRE[1] - y * SCALE


def _text(x: float, y: float, words: str, kind: str = "", anchor: str = "start") -> str:
    name = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.0f}" y="{y:.0f}"{name} text-anchor="{anchor}">{html.escape(words)}</text>'


def _yard() -> str:
    x, y = _at(0, 0)
    radius = ZONE * SCALE
    parts = [
        f'<clipPath id="yard"><rect width="1000" height="{BOTTOM}"/></clipPath>',
        f'<circle clip-path="url(#yard)" cx="{x}" cy="{y}" r="{radius}" fill="#ecfdf5" '
        'stroke="#059669" stroke-width="2"/>',
        f'<path d="M{x - 6} {y}h12M{x} {y - 6}v12" stroke="#059669" stroke-width="2"/>',
        _text(x - radius + 40, y + 60, "safe zone, 20 m around the origin", "small"),
        _text(x - 12, y + 5, "start", "small", "end"),
    ]
    for thing in physics.YARD:
        cx, cy = _at(thing.x, thing.y)
        parts.append(
            f'<circle cx="{cx}" cy="{cy}" r="{thing.radius * SCALE}" fill="#9ca3af" stroke="#374151"/>'
        )
    left, bottom = _at(-14, -9)
    parts.append(f'<path d="M{left} {bottom}v-5h{5 * SCALE}v5" fill="none" stroke="#4b5563"/>')
    parts.append(_text(left + 2.5 * SCALE, bottom - 9, "5 m", "small", "middle"))
    return "\n".join(parts)


def _track(poses: list[physics.Pose], kind: str) -> str:
    kept = [poses[0]]
    for pose in poses[1:]:
        if abs(pose.x - kept[-1].x) + abs(pose.y - kept[-1].y) > 0.02:
            kept.append(pose)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (_at(pose.x, pose.y) for pose in kept))
    return f'<polyline class="track {kind}" points="{points}"/>'


def _ends(without: "Drive", guarded: "Drive") -> list[str]:
    return [_end(drive.poses[-1], colour) for drive, colour in ((without, WITHOUT), (guarded, GUARDED))]


def _end(pose: physics.Pose, colour: str) -> str:
    x, y = _at(pose.x, pose.y)
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{colour}" stroke="#ffffff" stroke-width="2"/>'


def _note(x: float, y: float, row: float, lines: tuple[str, ...]) -> str:
    px, py = _at(x, y)
    left = 705.0
    words = [_text(left + 8, row + 18 * number, line) for number, line in enumerate(lines)]
    return f'<path class="leader" d="M{px:.1f} {py:.1f}L{left} {row - 5}"/>\n' + "\n".join(words)


def _notes(without: "Drive", guarded: "Drive") -> list[str]:
    thing = physics.YARD[0]
    high = max(without.poses, key=lambda pose: pose.x**2 + pose.y**2)
    border = max(guarded.poses, key=lambda pose: pose.x**2 + pose.y**2)
    east = max(guarded.poses[:220], key=lambda pose: pose.x)
    return [
        _note(high.x, high.y, 92,
              ("Without monitors: out of the yard,", f"{without.farthest():.1f} m from the origin.")),
        _note(border.x, border.y, 150,
              ("safeZone drops what drives on.", "The base follows the last command for",
               f"half a second: {guarded.farthest():.1f} m from the", "origin. Backing up stays possible.")),
        _note(thing.x + thing.radius * 0.7, thing.y + thing.radius * 0.7, 330,
              ("Without monitors: through the obstacle.",)),
        _note(east.x, east.y, 425,
              ("obstacleAvoidance sets the speed to 0", f"{guarded.nearest(thing):.2f} m before it; turning and",
               "backing up stay possible.")),
    ]  # fmt: skip


def _legend_of_ways() -> list[str]:
    parts = []
    for row, (kind, words) in enumerate((("without", "without monitors"), ("guarded", "with monitors"))):
        y = 545 + 26 * row
        parts.append(f'<path class="track {kind}" d="M698 {y - 5}h44"/>')
        parts.append(_text(752, y, words))
    parts.append('<circle cx="720" cy="593" r="7" fill="#6b7280"/>' + _text(752, 598, "end of the drive"))
    return parts


def _legend() -> str:
    parts = _legend_of_ways()
    parts.append(_star(720, 619, fired=True) + _text(752, 624, "a shot"))
    parts.append(_star(720, 645, fired=False) + _text(752, 650, "a shot that safeTrigger dropped"))
    return "\n".join(parts)


def _star(x: float, y: float, *, fired: bool) -> str:
    if fired:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="#16a34a" stroke="#ffffff" stroke-width="1.5"/>'
    cross = f"M{x - 6:.1f} {y - 6:.1f}l12 12M{x - 6:.1f} {y + 6:.1f}l12 -12"
    return f'<path d="{cross}" stroke="#b91c1c" stroke-width="3.5" stroke-linecap="round"/>'


def _gun(drive: "Drive") -> list[str]:
    left, top, width, height = STRIP
    low, high = physics.TILT_LIMITS

    def place(step: float, tilt: float) -> tuple[float, float]:
        return left + width * step / len(drive.tilts), top + height * (high - tilt) / (high - low)

    _, limit = place(0, LOWEST)
    points = " ".join(
        f"{x:.1f},{y:.1f}" for x, y in (place(step, tilt) for step, tilt in enumerate(drive.tilts))
    )
    parts = [
        _text(left, top - 12, "Angle of the gun over the time of the drive (monitors in force)"),
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="#f9fafb" stroke="#d1d5db"/>',
        f'<rect x="{left}" y="{limit:.1f}" width="{width}" height="{top + height - limit:.1f}" fill="#fee2e2"/>',
        _text(left + width - 8, top + height - 12, "the gun points at the robot itself", "small", "end"),
        _text(left - 8, limit + 4, f"{LOWEST}", "small", "end"),
        _text(left - 8, place(0, 0)[1] + 4, "0 rad", "small", "end"),
        f'<polyline class="track guarded" points="{points}"/>',
    ]
    start = drive.messages[0].time
    for second in range(0, len(drive.tilts) // 20 + 1, 10):
        x, _ = place(second * 20, 0)
        parts.append(_text(x, top + height + 18, f"{second} s", "small", "middle"))
    for shot in drive.shots:
        x, y = place((shot.time - start) / 50_000_000, shot.tilt)
        parts.append(_star(x, y, fired=shot.fired))
    return parts
