"""Propose guards for the topics of a running robot.

`robot_graph.py` decides which sources belong to a command. A source that is ambiguous is not chosen: the proposal is
left out, and a sentence names the alternatives. The advice ends with what no guard protects, which is never nothing.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from appliance.base.counted import counted
from appliance.features.guards import robot_graph as types
from appliance.features.guards.guard_answers import LoadedSuggestion, Suggestion, Suggestions
from appliance.features.guards.presets import PRESETS
from appliance.features.guards.robot_graph import (
    BOOL,
    CLOUD,
    JOY,
    MAX_COMMANDS,
    MAX_TOPICS,
    SIDE,
    STOP,
    RobotGraph,
    TopicFacts,
)

_WORD = re.compile(r"[a-z]+")
_WORDS_OF_A_STOP = {
    "pressed", "active", "activated", "triggered", "engaged", "hit", "on", "is", "button", "soft", "software",
    "hardware", "hw", "sw", "front", "rear", "back", "left", "right", "base", "robot", "platform", "wireless", "remote",
    "operator", "user", "topic", "stop",
}  # fmt: skip
_KNOWN_STOPS = re.compile(r"/(?:software_runstop_enabled|enable_software_runstop|is_runstopped)$")
"""True stops, by the drivers of Fetch and Stretch."""
_RESET = re.compile(r"(?:(?<![A-Za-z])[rc]|(?<![A-Z])[RC])(?:eset|lear)(?![a-z])|RESET|CLEAR")
"""A word of the name, not a part of another one, such as `clearpath` or `preset`."""
_FILTERED = re.compile(r"filtered|fused|ekf|local_position", re.IGNORECASE)
_WHEELS = re.compile(r"wheel|encoder|(?:^|[/_])(?:enc|raw)(?=[/_]|$)", re.IGNORECASE)
_NOT_AHEAD = re.compile(r"(?:^|[/_])(?:b|r|l|back|rear|left|right)(?=[/_]|$)", re.IGNORECASE)
_RAW = re.compile(r"(?:^|[/_])raw(?=[/_]|$)", re.IGNORECASE)
_AMCL = re.compile(r"amcl", re.IGNORECASE)
_NO_POSITION = re.compile(r"initialpose|goal|target|setpoint|ground_truth", re.IGNORECASE)
_WORLD_FRAME = re.compile(r"/mavros/setpoint_velocity/")  # MAVROS takes them in the local frame by default
_SCAN_OF_A_CAMERA = re.compile(r"camera|depth|rgbd", re.IGNORECASE)
_MANUAL = re.compile(r"(?:is_|in_)?manual(?:_?mode)?(?:_active|_enabled|_on)?", re.IGNORECASE)
_MODE = re.compile(r"manual|auto(?:nomous|matic)?(?=_|$)|(?:^|_)mode(?=_|$)", re.IGNORECASE)
_RESET_TOPIC = "/emergency_stop_reset"  # of `estop`, whose text is read later
_SLOWEST_HZ = 2.0
"""A base drives blind between two messages of a slower sensor."""
_STEADY_HZ = 5.0
"""A joystick that repeats its state at least this often."""

NOT_SUGGESTED = {
    "agree": "no name says which two velocities should be equal",
    "hold_to_run": "no name says that a person has to hold a switch",
    "overspeed": "its limits follow from the base, which the graph does not show",
    "rate": "a rate follows from the driver, which the graph does not show",
    "sane": "the other guards of a base stop it at values that are not finite",
    "standstill": "its time follows from how the base brakes, which the graph does not show",
    "withhold": "no name says which picture is private, and from whom",
    "zone": "its polygon follows from the outline of the base, which the graph does not show",
}
"""The presets that are never proposed, and why."""


def _command_line(preset: str, name: str, topics: Mapping[str, str], values: Mapping[str, str]) -> str:
    words = [f"rosrv guard new {preset} {topics['command']}"]
    words += [f"--by {topic}" if part == "by" else f"--topic {part}={topic}"
              for part, topic in topics.items() if part != "command"]  # fmt: skip
    if name != preset:
        words.append(f"--name {name}")
    words += ["--shadow", *(f"{parameter}={value}" for parameter, value in values.items())]
    return " ".join(words)


def advice(
    topics: Iterable[TopicFacts], loaded: Sequence[LoadedSuggestion] = (), names: Collection[str] = ()
) -> Suggestions:
    """Return guards for all topics that command a base or an arm. `names` are those of all monitors in use."""
    graph = RobotGraph(topics)
    writer = _Writer(graph, loaded, {*names, *(guard.name for guard in loaded)})
    for base in graph.bases:
        writer.add_base(base)
    for arm in graph.arm_velocities:
        writer.add_arm_velocity(arm)
    for arm in graph.arms:
        writer.add_arm(arm)
    for goal in graph.topics:
        if goal.type in types.GOALS:
            writer.add_goal(goal)
    for command in graph.velocities:
        writer.add_joystick(command)
    others = (topic for topic in graph.topics if topic.type in {*types.TRAJECTORIES, *types.GOALS})
    for command in (*graph.velocities, *others):
        writer.left_out.extend(inside(graph, command))
    unguarded = graph.unguarded_topics({*types.COMMANDS, *types.GOALS})
    if unguarded and graph.robots:
        named = ", ".join(f"{topic.name} ({topic.type})" for topic in unguarded[:_MAX_NAMED])
        writer.left_out.append(f"no preset works with these commands, which may also move the robot: {named}")
    if not graph.complete or MAX_COMMANDS in (len(graph.velocity_commands), len(graph.arms)):
        writer.left_out.append(
            f"only the first {MAX_COMMANDS} commands of each kind among {MAX_TOPICS} topics were read: others may"
            " need a guard"
        )
    for topic in graph.legs[:_MAX_NAMED]:
        writer.left_out.append(
            f"{topic.name} comes from {', '.join(topic.publishers)}, which carries out a velocity of the base: it may"
            " move legs, and a robot with legs may fall at a stop; if it moves an arm:"
            f" rosrv guard new joints {topic.name} --shadow"
        )
    for topic in graph.undecided[:_MAX_NAMED]:
        ends = f"{', '.join(topic.publishers)} to {', '.join(sorted(graph.ends(topic)))}"
        writer.left_out.append(
            f"{topic.name} ({topic.type}) goes from {ends}, and may be a command or a measurement; if it moves the"
            f" robot: rosrv guard new deadman {topic.name} --shadow"
        )
    return Suggestions(
        writer.found, writer.in_use, writer.left_out,
        [*writer.not_protected()], [*writer.not_protected(now=True)],
    )  # fmt: skip


def inside(graph: RobotGraph, command: TopicFacts) -> Iterator[str]:
    """Yield a sentence for each node that carries out commands of its own process, which the relay never gets."""
    for node in sorted(graph.ends(command).intersection(command.publishers)):
        yield f"{node} also publishes {command.name} to itself, as " + (
            "move_base does with the goals of rviz (/move_base_simple/goal): no guard gets these"
            if command.type in types.GOALS
            else "nodelets of one manager do: no guard gets these"
        )


class _Writer:
    """Collects the advice."""

    def __init__(self, graph: RobotGraph, loaded: Sequence[LoadedSuggestion], names: set[str]) -> None:
        self.graph, self._loaded, self._names = graph, loaded, names
        self._stops = {
            topic.name
            for topic in graph.topics
            if _stops(f"{topic.name.rsplit('/', 1)[0]}/{graph.leaf(topic)}")
        }
        self._common_stops = [topic for topic in graph.shared_topics({BOOL}) if topic.name in self._stops]
        self._alone = len([*graph.bases, *graph.arms, *graph.arm_velocities]) == 1
        self.found: list[Suggestion] = []
        self.in_use: list[LoadedSuggestion] = []
        self.left_out: list[str] = []

    def add_base(self, base: TopicFacts) -> None:
        self._add("deadman", base, _silence(base, 5, 0.2, 2))
        self._add_stops(base)
        self._add_fence(base)
        self._add_scanners(base)
        self._add("speed", base)
        self._add_mode(base)
        batteries = self.graph.sources(base, types.BATTERIES)
        if len(batteries) == 1:
            name = batteries[0].name
            self._add("ready", base, _silence(batteries[0], 5, 5, 600), topics={"by": name})
            self._say(
                f"ready of {base.name}: the scale of the charge in {name} is not known: read it with rosrv topic echo"
                f" {name}, and set hundred=true for 0 to 100, or most=1.3 for a charge above 1"
            )
        elif batteries:
            self._leave("ready", base, "several batteries fit", batteries)
        self._add_diagnostics(base)

    def _add_diagnostics(self, base: TopicFacts) -> None:
        found = self.graph.sources(base, types.DIAGNOSTICS)
        found = [topic for topic in found if self.graph.derived_from(topic, found)] or found
        if len(found) > 1:
            self._leave("diagnostics", base, "several topics have diagnostics", found)
        elif found:
            name = found[0].name
            self._add("diagnostics", base, topics={"by": name})
            self._say(
                f"diagnostics of {base.name}: whether a motion needs each entry of {name}, and how often it comes, is"
                f" not known: read the entries with rosrv topic echo {name}, and name those that count, such as"
                " named='Motor, Laser: *'"
            )

    def add_arm_velocity(self, arm: TopicFacts) -> None:
        self._add("deadman", arm, _silence(arm, 5, 0.2, 2))
        self._add_stops(arm)
        self._say(
            f"{arm.name} moves joints, not a base: it gets no fence, and no speed, whose defaults are those of a base;"
            f" if its values are metres and radians a second: rosrv guard new speed {arm.name} vMax=… wMax=…"
        )

    def add_arm(self, arm: TopicFacts) -> None:
        states = self.graph.sources(arm, {"sensor_msgs/JointState"})
        drivers = self.graph.robot_of(arm).drivers
        reported = [
            topic
            for topic in self.graph.topics
            if topic.type == "sensor_msgs/JointState" and not drivers.isdisjoint(topic.publishers)
        ]
        best = reported or states
        if len(best) == 1:
            self._add("joints", arm, topics={"state": best[0].name})
        else:
            why = (
                f"choose one of {', '.join(state.name for state in best)}"
                if best
                else "no topic has its joints"
            )
            self._say(
                f"joints of {arm.name} is left out: {why}:"
                f" rosrv guard new joints {arm.name} --topic state=TOPIC --shadow"
            )
        self._add_stops(arm)
        # A resting arm repeats its positions.
        if len(best) == 1:
            self._add("sensor", arm, _silence(best[0], 3, 0.1, 1), {"frozen": "0"}, topics={"by": best[0].name},
                      others=states)  # fmt: skip
        elif best:
            self._leave("sensor", arm, "several topics have its joints", best)

    def add_goal(self, goal: TopicFacts) -> None:
        before = goal.name.removesuffix("/goal")
        wanted = f"{before}/result", goal.type.replace("ActionGoal", "ActionResult")
        if self.graph.crosses(goal) and before != goal.name and wanted in {
            (topic.name, topic.type) for topic in self.graph.topics if topic.publishers
        }:  # fmt: skip
            self._add("answer", goal)

    def add_joystick(self, command: TopicFacts) -> None:
        """Propose to stop a command whose joystick is silent: some teleoperations repeat its last value."""
        if not command.publishers or not self.graph.crosses(command):
            return
        sticks = [
            topic for topic in self.graph.topics
            if topic.type == JOY and topic.publishers and {*command.publishers} <= {*topic.subscribers}
        ]  # fmt: skip
        for stick in sticks[:1]:
            if stick.rate >= _STEADY_HZ:
                self._add(
                    "sensor", command, _silence(stick, 5, 0.2, 1), {"frozen": "0"}, topics={"by": stick.name}
                )
            else:
                self._say(
                    f"{command.name} comes from the joystick {stick.name}, which is silent while it is not moved: to"
                    " guard its link, set autorepeat_rate of joy_node, and run rosrv guard suggest again"
                )

    def _add_stops(self, command: TopicFacts) -> None:
        switches = self.graph.sources(command, {BOOL})
        resets = [
            topic
            for topic in switches
            if STOP.search(topic.name) and _RESET.search(topic.name) and topic.name not in self._stops
        ]
        stops = [topic for topic in switches if topic.name in self._stops]
        stops = [
            topic for topic in stops if not any(self.graph.derived_from(other, [topic]) for other in stops)
        ]
        for stop in stops:
            topics = {"stop": stop.name}
            if len(resets) == 1:
                topics["reset"] = resets[0].name
            elif (robot := self.graph.robot_of(command)).namespace:
                topics["reset"] = robot.name_of("emergency_stop_reset")
            self._add(
                "estop",
                command,
                _silence_of_each(stop),
                _publishers(stop),
                several=len(stops) > 1,
                topics=topics,
            )
            self._say_buttons(stop, "estop")
            if not resets:
                self._say(
                    f"no node publishes {topics.get('reset', _RESET_TOPIC)}: after a press of a button the robot stays"
                    " stopped until a node sends true there; for another topic add --topic reset=TOPIC"
                )
        for topic in switches:
            if topic not in resets and STOP.search(topic.name) and topic.name not in self._stops:
                self._say(
                    f"{topic.name}: its name does not say whether true stops; {_by_hand('if it does', topic)}"
                )
        for topic in self.graph.topics:
            if (
                topic.type != BOOL
                and topic.publishers
                and topic.name in self._stops
                and self.graph.belongs(topic, command)
            ):
                self._say(f"{topic.name} has the type {topic.type}: an estop works with {BOOL} only")
        for topic in self._common_stops:
            self._say(
                f"{topic.name} belongs to no robot alone; {_by_hand('for each that it should stop', topic)}"
            )

    def _add_mode(self, base: TopicFacts) -> None:
        switches = [
            topic for topic in self.graph.sources(base, {BOOL}) if _MODE.search(self.graph.leaf(topic))
        ]
        manual = [topic for topic in switches if _MANUAL.fullmatch(self.graph.leaf(topic))]
        if len(manual) == 1:
            self._add("mode", base, _silence_of_each(manual[0]), _publishers(manual[0]),
                      topics={"by": manual[0].name})  # fmt: skip
            self._say_buttons(manual[0], "mode")
        elif manual:
            self._leave("mode", base, "several topics say manual mode", manual)
        for topic in switches:
            if topic not in manual:
                self._say(
                    f"{topic.name}: its name does not say that true means manual mode; if it does: rosrv guard new mode"
                    f" {base.name} --by {topic.name} --shadow"
                )

    def _say_buttons(self, button: TopicFacts, preset: str) -> None:
        """Say when the failure of a button is noticed late or never, and which nodes are its buttons."""
        rate = button.slowest()
        if len(button.publishers) > 1:
            self._say(
                f"{button.name} comes from {', '.join(button.publishers[:_MAX_NAMED])}: {preset} waits for"
                f" {counted(len(button.publishers), 'node')}; if not each is a button, set publishers"
            )
        if not button.rate and not button.subscribers:
            self._say(
                f"no node subscribes to {button.name}, so its rate is not known now: {preset} has the default of silent"
            )
        elif not rate:
            silent = "one of its publishers sends" if button.rate else "it sends"
            self._say(
                f"{button.name}: {silent} nothing now: {preset} stops the base until it does; if it sends only changes,"
                " set silent=0, and its failure is not noticed"
            )
        elif rate < _SLOWEST_HZ:
            self._say(
                f"{button.name} has a rate of only {rate:.3g} Hz, so its failure is noticed after"
                f" {_silence_of_each(button)['silent']} s: let it send 5 times a second or more"
            )

    def not_protected(self, *, now: bool = False) -> Iterator[str]:
        """Yield what stays without a guard, by command, and then what no guard protects.

        Proposals count, and guards in use unless they are disabled or broken; with `now`, only guards in force.
        """
        guards = {
            (guard.preset, guard.topics.get("command"))
            for guard in self._loaded
            if (guard.state in _IN_FORCE if now else guard.state not in ("off", "broken"))
        } | {(one.preset, one.topics["command"]) for one in self.found if not now}
        bases, arms = self.graph.bases, [*self.graph.arm_velocities, *self.graph.arms]
        for commands, presets, what, help_ in (
            ([*bases, *arms], ("estop",), "no button stops {}", self._no_button),
            (bases, ("separation", "zone"), "no guard stops {} before a person or a thing", self._no_scanner),
            (bases, ("fence",), "no area bounds {}", None),
            (bases, ("mode",), "no manual mode slows {}", self._no_mode),
            (bases, ("hold_to_run",), "no enabling device has to be held for {}", self._no_device),
            (bases, ("overspeed",), "no guard stops {} when the base is measured too fast", self._no_measurement),
            (arms, (), "no guard stops {} before the arm meets a person or a thing", None),
        ):  # fmt: skip
            bare = [one for one in commands if guards.isdisjoint((preset, one.name) for preset in presets)]
            if bare:
                advised = help_(bare[0]) if help_ and not now else ""
                yield what.format(_named(bare)) + (f": {advised}" if advised else "")
        if not (bases or arms):
            yield "nothing that moves here: no topic commands a base or an arm now"
        yield _NEVER_PROTECTED

    def _no_button(self, command: TopicFacts) -> str:
        new = f"rosrv guard new estop {command.name} --topic stop="
        others = [robot for robot in self.graph.robots if command not in robot.commands]
        there = [
            topic.name
            for topic in self.graph.topics
            if topic.type == BOOL and topic.name in self._stops and not self.graph.is_below(topic, others)
        ]
        if there:
            return f"if {there[0]} is also its button: {new}{there[0]} --shadow"
        return (
            f"let a node send std_msgs/Bool 5 times a second, true while it is pressed: {new}TOPIC --shadow"
        )

    def _no_scanner(self, command: TopicFacts) -> str:
        if any(line.startswith(f"separation of {command.name} ") for line in self.left_out):
            return "the reason is above"
        clouds = self.graph.sources(command, {CLOUD})
        if clouds:
            return (
                f"{clouds[0].name} is a PointCloud2, and a guard reads a LaserScan: run pointcloud_to_laserscan, and"
                " again: rosrv guard suggest"
            )
        return (
            "no LaserScan belongs to its robot alone; if there is one:"
            f" rosrv guard new separation {command.name} --by TOPIC --shadow"
        )

    def _no_mode(self, command: TopicFacts) -> str:
        return (
            "let a node send std_msgs/Bool, true in manual mode:"
            f" rosrv guard new mode {command.name} --by TOPIC --shadow"
        )

    def _no_device(self, command: TopicFacts) -> str:
        stick = next(
            (topic.name for topic in self.graph.topics if topic.type == JOY and topic.publishers), ""
        )
        by = f"--by {stick} --shadow button=N" if stick else "--by TOPIC --shadow"
        return f"where a person drives by hand: rosrv guard new hold_to_run {command.name} {by}"

    def _no_measurement(self, command: TopicFacts) -> str:
        odometries = {topic.name for topic in self.graph.topics if topic.type == "nav_msgs/Odometry"}
        places = [
            one.topics["by"]
            for one in self.found
            if one.preset == "fence" and one.topics["command"] == command.name
        ]
        by = next((place for place in places if place in odometries), "TOPIC")
        return f"rosrv guard new overspeed {command.name} --by {by} --shadow"

    def _add_fence(self, base: TopicFacts) -> None:
        places = self.graph.sources(base, types.POSES)
        sleeping = [topic for topic in places if self._comes_after_motion(topic)]
        places = [topic for topic in places if topic not in sleeping and not _NO_POSITION.search(topic.name)]
        if not places:
            title = self.graph.robot_of(base).title
            why = "".join(f"; {topic.name} is published only after a motion" for topic in sleeping)
            self._say(
                f"no odometry of {title} found{why}: give --by: rosrv guard new fence {base.name} --by TOPIC --shadow"
            )
            return
        ranked = sorted(places, key=lambda topic: self._rank(topic, places, base))
        best = [
            topic
            for topic in ranked
            if self._rank(topic, places, base) == self._rank(ranked[0], places, base)
        ]
        if len(best) > 1:
            self._leave("fence", base, "several odometries fit", best)
        elif 0 < best[0].rate < _SLOWEST_HZ:
            self._leave(
                "fence",
                base,
                _slow(best[0]),
                ranked[1:] or best,
            )
        else:
            frame = {"worldFrame": "true"} if _WORLD_FRAME.search(base.name) else {}
            self._add(
                "fence", base, _silence(best[0], 3, 0.2, 1), frame, topics={"by": best[0].name}, others=ranked
            )

    def _add_scanners(self, base: TopicFacts) -> None:
        scans = self.graph.sources(base, types.SCANS)
        for avoided in (_SCAN_OF_A_CAMERA, _RAW):
            scans = [topic for topic in scans if not avoided.search(topic.name)] or scans
        merged = [topic for topic in scans if self.graph.derived_from(topic, scans)]
        sides = [topic for topic in scans if SIDE.search(topic.name)]
        raw = sides if len(sides) > 1 else [topic for topic in scans if topic not in merged] or scans
        for preset, chosen in (("sensor", raw), ("separation", merged or raw)):
            several = len(chosen) > 1
            if preset == "separation" and chosen and _WORLD_FRAME.search(base.name):
                self._say(
                    f"separation of {base.name} is left out: it takes velocities in the frame of the base, and"
                    " these are in that of the map"
                )
                continue
            for scan in merged if preset == "separation" else ():
                self._say_merged(scan, raw, base)
            for scan in chosen:
                if 0 < scan.rate < _SLOWEST_HZ:
                    self._leave(preset, base, _slow(scan), [scan])
                else:
                    others = [topic for topic in scans if topic not in chosen]
                    self._add(
                        preset,
                        base,
                        _silence(scan, 3, 0.1, 1),
                        several=several,
                        topics={"by": scan.name},
                        others=others,
                    )
            if preset == "separation" and (several or any(_NOT_AHEAD.search(scan.name) for scan in chosen)):
                together = (
                    ", and each must permit a motion: if together they see all round, merge their scans, or also set"
                    " unseen to the highest velocity"
                )
                self._say(
                    "each separation needs the direction and the view of its scanner: set mounted and sector"
                    f"{together if several else ''} ({', '.join(scan.name for scan in chosen)})"
                )

    def _say_merged(self, scan: TopicFacts, watched: Sequence[TopicFacts], base: TopicFacts) -> None:
        origins = self.graph.origins(scan, {*types.SCANS, CLOUD})
        if len(origins) < 2:
            return
        named = ", ".join(topic.name for topic in origins)
        alone = [topic.name for topic in origins if topic not in watched]
        self._say(
            f"{scan.name} is merged from {named}: if one of them fails it may go on without that part, so "
            + (
                f"also watch {', '.join(alone)}: rosrv guard new sensor {base.name} --by {alone[0]} --shadow"
                if alone
                else "enforce the sensor of each together with the separation"
            )
        )

    def _comes_after_motion(self, topic: TopicFacts) -> bool:
        """Whether a particle filter publishes it, which waits for the robot to move."""
        return topic.type != "nav_msgs/Odometry" and (
            bool(_AMCL.search(topic.name))
            or any(
                _AMCL.search(node) or self.graph.publishes(node, {"geometry_msgs/PoseArray"})
                for node in topic.publishers
            )
        )

    def _rank(
        self, topic: TopicFacts, places: Sequence[TopicFacts], base: TopicFacts
    ) -> tuple[int, int, int]:
        odometry = topic.type == "nav_msgs/Odometry"
        if odometry and (_FILTERED.search(topic.name) or self.graph.derived_from(topic, places)):
            level = 0
        elif odometry and not self.graph.robot_of(base).drivers.isdisjoint(topic.publishers):
            level = 1
        else:
            level = 2 if odometry else 3 + (topic.type != "geometry_msgs/PoseStamped")
        return level, int(bool(_WHEELS.search(topic.name))), -self.graph.near(topic, base)

    def _add(
        self,
        preset: str,
        command: TopicFacts,
        measured: Mapping[str, str] | None = None,
        values: Mapping[str, str] | None = None,
        *,
        several: bool = False,
        others: Iterable[TopicFacts] = (),
        topics: Mapping[str, str] | None = None,
    ) -> None:
        topics = {"command": command.name, **(topics or {})}
        for guard in self._loaded:
            told_apart = ("command", *_OWN_GUARD.get(preset, ()))
            if guard.preset == preset and all(guard.topics.get(name) == topics[name] for name in told_apart):
                if guard not in self.in_use:
                    self.in_use.append(guard)
                return
        source = topics.get("by") or topics.get("stop") or ""
        heard, most = topics.get("state", source), _MOST_PUBLISHERS.get(preset)
        number = next((len(topic.publishers) for topic in self.graph.topics if topic.name == heard), 0)
        if most is not None and number > most:
            self._say(
                f"{preset} of {command.name} is left out: {counted(number, 'node publishes', 'nodes publish')} {heard},"
                f" and it follows {most}: let each publish on a topic of its own"
            )
            return
        short = command.name.removesuffix("/follow_joint_trajectory/goal")
        parts = [preset, *([] if self._alone else [short]), *([source] if several else [])]
        name = next(name for name in _names(parts, command.name) if name not in self._names)
        self._names.add(name)
        alternatives = [topic.name for topic in others if topic.name != topics.get("by")]
        measured, values = dict(measured or {}), dict(values or {})
        line = _command_line(preset, name, topics, measured | values)
        self.found.append(
            Suggestion(preset, name, PRESETS[preset].what, topics, measured, values, line,
                       {"by": alternatives} if alternatives else {})
        )  # fmt: skip

    def _leave(self, preset: str, command: TopicFacts, why: str, topics: Sequence[TopicFacts]) -> None:
        choice = "" if len(topics) == 1 else f"; choose one of {', '.join(topic.name for topic in topics)}"
        by = topics[0].name if len(topics) == 1 else "TOPIC"
        self._say(
            f"{preset} of {command.name} is left out: {why}{choice}:"
            f" rosrv guard new {preset} {command.name} --by {by} --shadow"
        )

    def _say(self, sentence: str) -> None:
        if sentence not in self.left_out:
            self.left_out.append(sentence)


_IN_FORCE = {"free", "stopping", "withholding"}
_MOST_PUBLISHERS = {"fence": 1, "ready": 1, "sensor": 1, "separation": 1, "joints": 2}
"""The nodes on the topic of a guard beyond which it stops the robot for ever."""
_OWN_GUARD = {"sensor": ("by",), "separation": ("by",), "estop": ("stop",)}
"""The topics that have a guard of their own each."""


_NEVER_PROTECTED = (
    "never by a guard: persons and things that no sensor of a guard sees; motions that come by no guarded topic; a"
    " failure of this appliance, its power or its network, for which the driver needs its own timeout and the robot its"
    " own emergency stop; and nothing is stopped by a guard in shadow mode"
)
_MAX_NAMED = 5


def _named(topics: Sequence[TopicFacts]) -> str:
    named = ", ".join(topic.name for topic in topics[:_MAX_NAMED])
    return f"{named} and {len(topics) - _MAX_NAMED} others" if len(topics) > _MAX_NAMED else named


def _stops(topic: str) -> bool:
    """Whether true on the topic means stop: no word of its name says the opposite, or something else."""
    if _KNOWN_STOPS.search(topic):
        return True
    leaf = topic.rsplit("/", 1)[1].lower()
    rest = STOP.sub(" ", leaf)
    return rest != leaf and {*_WORD.findall(rest)} <= _WORDS_OF_A_STOP


def _slow(topic: TopicFacts) -> str:
    return f"{topic.name} has a rate of only {topic.rate:.3g} Hz"


def _by_hand(when: str, stop: TopicFacts) -> str:
    return f"{when}: rosrv guard new estop TOPIC --topic stop={stop.name} --shadow"


def _names(parts: list[str], command: str) -> Iterator[str]:
    tail = "_".join(_slug(part) for part in parts[1:])
    yield f"{parts[0]}_{tail[-50:]}".rstrip("_")
    yield f"{parts[0]}_{_slug(command)[-50:]}"
    number = 2
    while True:
        yield f"{parts[0]}_{tail[-46:]}_{number}".replace("__", "_")
        number += 1


def _slug(topic: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", topic.lower()).strip("_")


def _publishers(topic: TopicFacts) -> dict[str, str]:
    """Return the number of nodes that have to be heard, if a guard can know all of them."""
    return {"publishers": f"{len(topic.publishers)}"} if len(topic.publishers) <= _MAX_PUBLISHERS else {}


def _silence_of_each(topic: TopicFacts) -> dict[str, str]:
    """Allow one lost message of the slowest publisher, which also may be late by half a period."""
    rate = topic.slowest()
    return {"silent": f"{min(max(2.5 / rate, 0.5), 60):.3g}"} if rate > 0 else {}


_MAX_PUBLISHERS = 8


def _silence(topic: TopicFacts, periods: int, least: float, most: float) -> dict[str, str]:
    """Allow some periods of the slowest publisher that sends now: each is judged alone."""
    rate = topic.slowest(sending=True)
    return {"silent": f"{min(max(periods / rate, least), most):.3g}"} if rate > 0 else {}
