from appliance.channel.operations import CHANGES, OPERATIONS


def test_changes_are_for_operators_and_admins() -> None:
    listed = {operation.request for operation in OPERATIONS if operation.role in ("operator", "admin")}
    reads = {str(request.__struct_config__.tag) for request in listed - CHANGES}
    assert reads - {"sso list", "host kit", "topic look"} == {"token list", "monitor try", "monitor values"}
    assert {str(request.__struct_config__.tag) for request in CHANGES - listed} <= {
        "recording memory",
        "door visit",
        "sso sign out",
    }
