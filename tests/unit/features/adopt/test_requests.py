import msgspec
import pytest

from appliance.channel.admin import AdminRequest
from appliance.channel.operations import OPERATIONS, RestRequest
from appliance.features.adopt.requests import REQUESTS


@pytest.mark.parametrize("request_kind", REQUESTS, ids=lambda kind: kind.__name__)
def test_no_order_of_an_adoption_comes_over_rest(request_kind: type[AdminRequest[object]]) -> None:
    assert request_kind not in {operation.request for operation in OPERATIONS}
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"verb": request_kind.__struct_config__.tag}, RestRequest)
