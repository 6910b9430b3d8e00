"""XML-RPC as ROS 1 uses it, without I/O. Received bytes are never forwarded, but parsed and encoded again."""

from roswire.xmlrpc.common_documents import FaultReceived, MethodCall, parse_call, parse_response
from roswire.xmlrpc.xmlrpc_values import DEFAULT_LIMITS, Value, XmlRpcLimits
from roswire.xmlrpc.xmlrpc_writer import build_call, build_fault, build_response

__all__ = [
    "DEFAULT_LIMITS",
    "FaultReceived",
    "MethodCall",
    "Value",
    "XmlRpcLimits",
    "build_call",
    "build_fault",
    "build_response",
    "parse_call",
    "parse_response",
]
