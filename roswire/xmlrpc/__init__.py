"""XML-RPC as ROS 1 speaks it, without I/O: requests and answers from bytes, under limits, and to bytes.

Nothing that was received is sent on as bytes: it is parsed into values (`reader`, and `usual` for what is plain),
decided on, and written afresh (`writer`).
"""

from dataclasses import dataclass

from roswire.errors import LimitExceededError, PeerError, ProtocolError
from roswire.xmlrpc.common_documents import usual_answer, usual_call
from roswire.xmlrpc.xmlrpc_reader import Document
from roswire.xmlrpc.xmlrpc_values import DEFAULT_LIMITS, Limits, Value
from roswire.xmlrpc.xmlrpc_writer import build_call, build_fault, build_response

__all__ = [
    "DEFAULT_LIMITS",
    "FaultReceived",
    "Limits",
    "MethodCall",
    "Value",
    "build_call",
    "build_fault",
    "build_response",
    "parse_call",
    "parse_response",
]


@dataclass(frozen=True, slots=True)
class MethodCall:
    """A request: the name of the method, as it came, and its parameters."""

    method: str
    params: tuple[Value, ...]


class FaultReceived(PeerError):  # noqa: N818 - named as the event it is: the answer was a fault
    """The answer was a fault: the method could not be carried out."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"fault {code}: {text}")
        self.code = code
        self.text = text


def parse_call(body: bytes, limits: Limits = DEFAULT_LIMITS) -> MethodCall:
    """Parse a request; raises `ProtocolError` or `LimitExceededError`."""
    usual = usual_call(body, limits)
    if usual is None:
        document = Document(body, limits, "methodCall")
        usual = document.method, document.values
    method, params = usual
    if method == "system.multicall" and params:
        parts = params[0]
        if isinstance(parts, list) and len(parts) > limits.parts:
            raise LimitExceededError(
                f"system.multicall of {len(parts)} calls; at most {limits.parts} are allowed"
            )
    return MethodCall(method, tuple(params))


def parse_response(body: bytes, limits: Limits = DEFAULT_LIMITS) -> Value:
    """Parse an answer; raises `FaultReceived` if it is a fault, `ProtocolError` or `LimitExceededError`."""
    usual = usual_answer(body, limits)
    if usual is not None:
        return usual
    document = Document(body, limits, "methodResponse")
    if len(document.values) != 1:
        raise ProtocolError(f"answer with {len(document.values)} values; it has one")
    value = document.values[0]
    if not document.is_fault:
        return value
    if isinstance(value, dict):
        code, text = value.get("faultCode"), value.get("faultString")
        if type(code) is int and isinstance(text, str):
            raise FaultReceived(code, text)
    raise ProtocolError("fault without an integer faultCode and a string faultString")
