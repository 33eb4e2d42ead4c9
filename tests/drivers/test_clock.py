import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.ur5.clock import ClockOffset

PERIOD_NS = 8_000_000
delays = st.lists(st.integers(0, 40_000_000), min_size=1, max_size=60)


def arrivals(delays_ns, offset_ns=123_456_789_000, drift_ppm=0):
    """Controller stamps (s), true host times (ns) and arrival times (ns) of packages."""
    controller_ns = np.arange(1, len(delays_ns) + 1) * PERIOD_NS
    true_ns = offset_ns + controller_ns + controller_ns * drift_ppm // 1_000_000
    arrived_ns = np.maximum.accumulate(true_ns + np.array(delays_ns))
    return controller_ns / 1e9, true_ns, arrived_ns


@given(delays)
def test_stamps_increase_strictly_and_never_lie_after_the_arrival(delays_ns):
    stamps_s, _, arrived_ns = arrivals(delays_ns)
    clock = ClockOffset()
    host = [clock.host_ns(s, a) for s, a in zip(stamps_s, arrived_ns.tolist(), strict=True)]
    assert (np.diff(host) > 0).all()
    assert all(h <= a + len(host) for h, a in zip(host, arrived_ns, strict=True))


@given(delays)
def test_after_one_punctual_package_the_delay_of_the_others_does_not_matter(delays_ns):
    stamps_s, true_ns, arrived_ns = arrivals([0, *delays_ns])
    clock = ClockOffset()
    for stamp_s, true, arrived in zip(stamps_s, true_ns, arrived_ns.tolist(), strict=True):
        assert abs(clock.host_ns(stamp_s, arrived) - true) < 1000


def test_drift_is_followed():
    generator = np.random.default_rng(0)
    delays_ns = generator.integers(0, 3_000_000, 8000)
    stamps_s, true_ns, arrived_ns = arrivals(delays_ns, drift_ppm=50)
    clock = ClockOffset(window_ns=2_000_000_000)
    errors = [
        clock.host_ns(stamp_s, arrived) - true
        for stamp_s, true, arrived in zip(stamps_s, true_ns, arrived_ns.tolist(), strict=True)
    ]
    assert np.abs(errors[500:]).max() < 300_000
