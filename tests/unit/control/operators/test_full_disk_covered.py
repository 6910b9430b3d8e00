from appliance.channel import admin
from appliance.control.operators.administration import KEPT
from tests.integration.test_full_disk import ORDERS, UNSTORED


def test_each_stored_change_is_tried_on_a_full_disk() -> None:
    kept = {str(request.__struct_config__.tag) for request in KEPT}
    assert {admin.verb_of(order) for order in ORDERS} == kept - UNSTORED
