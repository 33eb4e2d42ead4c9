"""Which messages belong to one exposure."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from canopy_skel.recording.mcap_file import McapFile, MessageRef
from canopy_skel.recording.options import (
    CALIBRATION_ROLES,
    EXPOSURE_ROLES,
    PICTURE_ROLES,
    TopicOptions,
)

RefsByRole = Mapping[str, list[MessageRef]]


@dataclass(kw_only=True, slots=True)
class Group:
    """The messages of one view by role.

    flaw: why the view cannot be used, if so. partial: because some of its messages were lost.
    """

    index: int
    refs: dict[str, MessageRef] = field(default_factory=dict)
    flaw: str | None = None
    partial: bool = False


def refs_by_role(file: McapFile, options: TopicOptions) -> dict[str, list[MessageRef]]:
    """Return the messages of every topic that has a role, in file order."""
    roles = {one.id: options.role_of(one.topic) for one in file.channels.values()}
    found: dict[str, list[MessageRef]] = {}
    for ref in file.messages:
        role = roles.get(ref.channel_id)
        if role is not None:
            found.setdefault(role, []).append(ref)
    return found


def group_by_sequence(by_role: RefsByRole) -> list[Group]:
    """Group messages that carry the index of their view as `sequence`.

    Several views with one index are told apart by their stamps (`log_time`), so that no view is put
    together from two. The first in the file is kept and the others are returned with a flaw.
    """
    own: dict[int, dict[str, list[MessageRef]]] = {}
    for role in EXPOSURE_ROLES:
        for ref in by_role.get(role, ()):
            own.setdefault(ref.sequence, {}).setdefault(role, []).append(ref)
    groups: list[Group] = []
    for index in sorted(own):
        first, *others = _with_index(index, own[index], by_role)
        for group in others:
            group.flaw = (
                f"view {index}: a second view with this index; the first is used (number the"
                " messages of each view by `sequence`)"
            )
        groups += [first, *others]
    return groups


def pair_by_stamp(
    by_role: RefsByRole, stamp_ns: Callable[[MessageRef], int], max_gap_ns: int
) -> tuple[list[Group], int]:
    """Group pictures by nearest stamp around each colour (else left) image.

    Two pictures pair if each is the other's nearest and they are at most `max_gap_ns` apart.
    Scores carry no stamp and pair by the time they were recorded.

    Returns:
        the colour images with depth or with a whole pair, numbered by stamp; the number of others.
    """
    main = "color_image" if by_role.get("color_image") else "left_image"
    exposures = sorted(by_role.get(main, ()), key=stamp_ns)
    groups = [Group(index=0, refs={main: ref}) for ref in exposures]
    times = np.array([stamp_ns(ref) for ref in exposures], dtype=np.int64)
    for role in (*PICTURE_ROLES, *CALIBRATION_ROLES):
        others = sorted(by_role.get(role, ()), key=stamp_ns)
        if role == main or not others or not groups:
            continue
        other_times = np.array([stamp_ns(ref) for ref in others], dtype=np.int64)
        partner = _nearest(times, other_times)
        mutual = _nearest(other_times, times)[partner] == np.arange(len(groups))
        close = np.abs(other_times[partner] - times) <= max_gap_ns
        paired = mutual & close if role in PICTURE_ROLES else np.full(len(groups), True)
        for i in np.flatnonzero(paired):
            groups[i].refs[role] = others[partner[i]]
    _pair_scores(groups, by_role.get("scores", []), max_gap_ns)
    whole = [group for group in groups if _measures(group)]
    for index, group in enumerate(whole):
        group.index = index
    return whole, len(groups) - len(whole)


def mark_cut_off(groups: list[Group], suspects: list[Group], options: TopicOptions) -> None:
    """Give a flaw to those suspects that lack what other views have."""
    usual = {role for group in groups for role in group.refs}
    for group in suspects:
        lacking = [role for role in EXPOSURE_ROLES if role in usual and role not in group.refs]
        if lacking and group.flaw is None:
            group.partial = True
            topics = ", ".join(getattr(options, role) for role in lacking)
            group.flaw = (
                f"view {group.index}: lost in part, without {topics} (the recording is cut off or"
                " damaged there)"
            )


def _with_index(index: int, own: RefsByRole, by_role: RefsByRole) -> list[Group]:
    """Return the views of one index in file order: as many as it has messages in any one role.

    Each other message goes to the view nearest in time, of views at one time to the first without.
    """
    fullest = max(own, key=lambda role: len(own[role]))
    views = [Group(index=index, refs={fullest: ref}) for ref in own[fullest]]
    at_stamp: dict[int, list[Group]] = {}
    for group in views:
        at_stamp.setdefault(group.refs[fullest].log_time_ns, []).append(group)

    def nearest(ref: MessageRef) -> int:
        return min(at_stamp, key=lambda stamp_ns: abs(stamp_ns - ref.log_time_ns))

    for role in own.keys() - {fullest}:
        for ref in own[role]:
            lacking = (group for group in at_stamp[nearest(ref)] if role not in group.refs)
            group = next(lacking, at_stamp[nearest(ref)][0])
            group.refs.setdefault(role, ref)
    for role in CALIBRATION_ROLES:
        refs = by_role.get(role, [])
        mine = {nearest(ref): ref for ref in reversed(refs) if ref.sequence == index}
        for stamp_ns, groups in at_stamp.items():
            for group in groups:
                calibration = mine.get(stamp_ns) or _latest_before(refs, group)
                if calibration is not None:
                    group.refs[role] = calibration
    return views


def _latest_before(refs: list[MessageRef], group: Group) -> MessageRef | None:
    stamp_ns = max(ref.log_time_ns for role, ref in group.refs.items() if role in EXPOSURE_ROLES)
    earlier = [ref for ref in refs if ref.log_time_ns <= stamp_ns]
    return max(earlier, key=lambda ref: ref.log_time_ns, default=None)


def _pair_scores(groups: list[Group], scores: list[MessageRef], max_gap_ns: int) -> None:
    with_instances = [group for group in groups if "instances" in group.refs]
    if not with_instances or not scores:
        return
    times = np.array([ref.log_time_ns for ref in scores], dtype=np.int64)
    order = np.argsort(times, kind="stable")
    recorded = np.array([g.refs["instances"].log_time_ns for g in with_instances], dtype=np.int64)
    nearest = order[_nearest(recorded, times[order])]
    for group, time_ns, i in zip(with_instances, recorded, nearest, strict=True):
        if abs(times[i] - time_ns) <= max_gap_ns:
            group.refs["scores"] = scores[i]


def _nearest(times: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return for each time the position of the nearest of the sorted times `among`."""
    right = np.clip(np.searchsorted(among, times), 1, max(len(among) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(among) - 1)
    return np.where(times - among[left] <= among[right] - times, left, right)


def _measures(group: Group) -> bool:
    return "depth_image" in group.refs or {"left_image", "right_image"} <= set(group.refs)
