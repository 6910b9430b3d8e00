"""The commands `rosrv node list` and `rosrv topic list`."""

from appliance.base.counted import counted
from appliance.channel.admin import GraphWanted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json, say_row
from rosmop.tool.terminal import say


@speaks
def list_nodes(appliance: Appliance) -> None:
    """List the nodes with their hosts, and whether they answer.

    Example: rosrv node list
    """
    nodes = sorted(appliance.ask_or_exit(GraphWanted()).nodes, key=lambda node: node.name)
    width = max((len(node.name) for node in nodes), default=0)
    hosts = {node.host: "" if appliance.as_json else appliance.host_in_words(node.host) for node in nodes}
    room = max(map(len, hosts.values()), default=0)
    for node in nodes:
        if appliance.as_json:
            say_json(node)
            continue
        counts = ", ".join(
            counted(len(names), noun)
            for names, noun in (
                (node.publishes, "publication"), (node.subscribes, "subscription"), (node.offers, "service")
            )
        )  # fmt: skip
        lost = "  lost: it does not answer" if node.state == "lost" else ""
        say_row(
            [f"{node.name:<{width}}", f"{hosts[node.host]:<{room}}", f"{counts}{lost}"], "red" if lost else ""
        )
    if not nodes and not appliance.as_json:
        say("no node is registered")


@speaks
def list_topics(appliance: Appliance) -> None:
    """List the topics with their types, publishers, subscribers and rates.

    Example: rosrv topic list
    """
    topics = sorted(appliance.ask_or_exit(GraphWanted()).topics, key=lambda topic: topic.name)
    name, kind = (max((len(text) for text in texts), default=0) for texts in (
        [topic.name for topic in topics], [topic.type for topic in topics],
    ))  # fmt: skip
    for topic in topics:
        if appliance.as_json:
            say_json(topic)
            continue
        rate = sum(publisher.messages_per_second for publisher in topic.publishers)
        ends = (
            f"{counted(len(topic.publishers), 'publisher')}, {counted(len(topic.subscribers), 'subscriber')}"
        )
        past = "" if topic.mediated else "  bypasses the appliance"
        say_row([f"{topic.name:<{name}}", f"{topic.type:<{kind}}", f"{ends}, {rate:.1f} Hz{past}"])
    if any(topic.mediated and not topic.subscribers for topic in topics) and not appliance.as_json:
        say(
            "(messages without a subscriber pass the relay only for monitors: 0.0 Hz need not be silence)",
            "dim",
        )
    if not topics and not appliance.as_json:
        say("no topic is registered")
