"""Pictures pair with their nearest in time, each with one."""

from hypothesis import given
from hypothesis import strategies as st

from canopy_skel.recording.grouping import pair_by_stamp
from canopy_skel.recording.mcap_file import MessageRef

MAX_GAP_NS = 20
times = st.lists(st.integers(0, 300), min_size=1, max_size=12, unique=True)


def refs(channel_id: int, stamps: list[int]) -> list[MessageRef]:
    return [MessageRef(channel_id, 0, t, t, None, i, 0) for i, t in enumerate(stamps)]


@given(times, times)
def test_pairs_are_mutually_nearest_and_close(color_ns, depth_ns):
    by_role = {"color_image": refs(1, color_ns), "depth_image": refs(2, depth_ns)}
    groups, alone = pair_by_stamp(by_role, lambda ref: ref.log_time_ns, MAX_GAP_NS)

    def nearest(t: int, among: list[int]) -> int:
        return min(among, key=lambda other: (abs(other - t), other))

    expected = [
        (t, nearest(t, depth_ns))
        for t in sorted(color_ns)
        if nearest(nearest(t, depth_ns), color_ns) == t
        and abs(nearest(t, depth_ns) - t) <= MAX_GAP_NS
    ]
    found = [
        (group.refs["color_image"].log_time_ns, group.refs["depth_image"].log_time_ns)
        for group in groups
    ]
    assert found == expected
    assert [group.index for group in groups] == list(range(len(groups)))
    assert alone == len(color_ns) - len(groups)
    assert len({depth for _, depth in found}) == len(found)
