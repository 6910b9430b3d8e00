import pytest

from appliance.control.operators.limit_use import of_pool
from appliance.features.limits import verb
from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import PARAMETER_BYTES


@pytest.mark.parametrize("hosts", [1, 1000])
@pytest.mark.parametrize("quota_class", QuotaClass)
def test_holders_that_are_refused_are_marked(quota_class: QuotaClass, hosts: int) -> None:
    pool: Pool[str] = Pool("bytes of parameters", PARAMETER_BYTES.bounds, lambda _host: quota_class)
    for number in range(hosts):
        if pool.refusal(f"host {number}", 1 << 16):
            break
        while not pool.take(f"host {number}", 1 << 16):
            pass
    assert pool.refusal(f"host {number}", 1 << 16)
    assert verb._is_near(of_pool("bytes of parameters", "", pool))
