"""Every call that `[Commands]` may grant, and why some calls are not among them.

A call that is not here is unknown and denied, `default` or not.
"""

COMMANDS = frozenset(
    {
        # Master API, reading
        "lookupNode",
        "lookupService",
        "getSystemState",
        "getPublishedTopics",
        "getTopicTypes",
        "getUri",
        "getPid",
        # parameters
        "getParam",
        "setParam",
        "hasParam",
        "deleteParam",
        "searchParam",
        "getParamNames",
        "subscribeParam",
        "unsubscribeParam",
        # node API
        "getBusInfo",
        "getBusStats",
        "getMasterUri",
        "getSubscriptions",
        "getPublications",
        "getName",
        "shutdown",
        # introspection of the XML-RPC server
        "listMethods",
        "methodHelp",
        "methodSignature",
        # RVMaster's own
        "getMonitors",
        "monitorControl",
        "getRVState",
        "shutdownMaster",
    }
)

NAMED_ONLY = frozenset({"getRVState", "shutdownMaster"})
"""Granted by their own key only, never by `default`: they end the appliance or tell what it hides."""

STARTING_COMMANDS = {
    "getParam": "rospy and roscpp read /use_sim_time with it when they start",
    "hasParam": "roscpp looks for /use_sim_time with it when it starts",
}
"""What an unmodified rospy or roscpp node calls while it starts, and for what."""

ALIASES = {
    "system.listMethods": "listMethods",
    "system.methodHelp": "methodHelp",
    "system.methodSignature": "methodSignature",
}
"""Names on the wire of calls that the policy knows by a shorter one."""

DECIDED_ELSEWHERE = {
    "registerPublisher": "[Nodes] and [Publishers]",
    "unregisterPublisher": "[Nodes] and [Publishers]",
    "registerSubscriber": "[Nodes] and [Subscribers]",
    "unregisterSubscriber": "[Nodes] and [Subscribers]",
    "registerService": "[Nodes] and [Services]",
    "unregisterService": "[Nodes] and [Services]",
    "requestTopic": "[Nodes] and [Subscribers]",
    "system.multicall": "the rules of each of its parts",
    "publisherUpdate": "nobody: only the master sends it",
    "paramUpdate": "nobody: only the master sends it",
}
"""Calls that `[Commands]` does not decide, and what does."""
