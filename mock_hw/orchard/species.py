"""What describes a species: growth, leaves, fruit and colours."""

from dataclasses import dataclass

Range = tuple[float, float]
Rgb = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Growth:
    """How the branches of one order grow on their parent (order 0: the trunk, on the ground).

    per_metre: branches per metre of the parent's bearing span; span: the part of the parent's
    length (0 base, 1 tip) that bears them. length_m and angle_deg: at the lower end, the middle
    and the upper end of the span; angle_deg is measured from the parent's direction.
    rise: turn towards the sky per metre, rad/m (negative: droops). hold: pull back to the first
    heading, 1/m. crook_deg: random turn at each node; node_m: distance between nodes.
    whorl_deg: azimuth step from one branch to the next. stoutness: base radius per length;
    radius_share: largest base radius as a share of the parent's. taper: 1 = a cone.
    """

    per_metre: float
    span: Range
    length_m: tuple[float, float, float]
    length_spread: float
    angle_deg: tuple[float, float, float]
    angle_spread_deg: float
    rise: float
    hold: float
    crook_deg: float
    node_m: float
    stoutness: float
    radius_share: float
    taper: float
    whorl_deg: float = 137.5


@dataclass(frozen=True, kw_only=True, slots=True)
class LeafShape:
    """One leaf or leaflet: half width over length at stations along the midrib.

    leaflets: 1 = simple; else pinnate with a terminal leaflet. cluster: leaves that leave one bud.
    bearing: share of leaves per metre of wood of each order, tip_bias: 0 = all along the
    branch, larger = towards the tip. droop: how far blades hang. curl, fold: bend along and
    across the midrib.
    """

    stations: tuple[float, ...]
    half_width: tuple[float, ...]
    length_m: Range
    petiole_m: Range
    leaflets: int
    cluster: int
    bearing: tuple[float, ...]
    tip_bias: float
    droop: float
    curl: Range
    fold: Range


@dataclass(frozen=True, kw_only=True, slots=True)
class FruitShape:
    """Fruit, hanging from thin wood: radius, stalk length, number per tree."""

    radius_m: Range
    stalk_m: float
    count: int
    flatness: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Colours:
    """Linear reflectances: bark of old wood and of shoots, leaf above and below, fruit twice."""

    bark: Rgb
    shoot: Rgb
    leaf_above: Rgb
    leaf_below: Rgb
    leaf_through: Rgb
    fruit: Rgb
    fruit_cheek: Rgb
    furrow: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Species:
    """A species preset; `orders` holds the growth of the trunk, the limbs and so on.

    forked: the trunk goes over into limbs of its own strength instead of a leader.
    detectable: target of V_det at foliage density 1..4.
    """

    name: str
    trunk_radius_m: Range
    tip_radius_m: float
    lean_deg: float
    forked: bool
    orders: tuple[Growth, ...]
    leaf: LeafShape
    fruit: FruitShape | None
    colours: Colours
    detectable: tuple[float, float, float, float]
