import os

from appliance.network.socket_owners import NodeSockets, is_node, process_key, program_of


def test_a_process_that_was_a_node_before_is_one() -> None:
    own = NodeSockets(os.getpid(), frozenset({5001}), "")
    assert is_node(own, {process_key(own.pid)})
    assert process_key(own.pid) != process_key(os.getppid())


def test_a_process_that_has_ended_has_neither_key_nor_name() -> None:
    gone = 1 << 30  # beyond the largest number
    assert (process_key(gone), program_of(gone)) == ("", "")
    assert not is_node(NodeSockets(gone, frozenset(), ""), ())
