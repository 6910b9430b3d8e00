"""A ROS 1 node in asyncio: topics as bytes, services, and the node API. All connections use one source address."""

from roswire.node.network import (
    MasterDenialError,
    NodeCallError,
    NodeNetwork,
    PeerUnreachableError,
    ServiceFailedError,
    SourceNetwork,
)
from roswire.node.ros_node import RosNode
from roswire.node.services import ServiceServer, ServiceType
from roswire.node.tcpros_streams import ANY_TYPE, MessageType, NodeLimits
from roswire.node.topics import NodePublication, NodeSubscription

__all__ = [
    "ANY_TYPE",
    "MasterDenialError",
    "MessageType",
    "NodeCallError",
    "NodeLimits",
    "NodeNetwork",
    "NodePublication",
    "NodeSubscription",
    "PeerUnreachableError",
    "RosNode",
    "ServiceFailedError",
    "ServiceServer",
    "ServiceType",
    "SourceNetwork",
]
