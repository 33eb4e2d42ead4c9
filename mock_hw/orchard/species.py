"""What makes an apple an apple: growth, leaves, fruit and colours of the three species."""

from dataclasses import dataclass

from canopy_skel.errors import UsageError

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
    """A species preset; `orders` holds the growth of order 0, 1, 2, …

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


APPLE = Species(
    name="apple",
    trunk_radius_m=(0.026, 0.033),
    tip_radius_m=0.0022,
    lean_deg=2.0,
    forked=False,
    orders=(
        Growth(
            per_metre=0.0, span=(0.0, 1.0), length_m=(1.78, 1.78, 1.78), length_spread=0.02,
            angle_deg=(0.0, 0.0, 0.0), angle_spread_deg=0.0, rise=0.4, hold=1.5, crook_deg=2.5,
            node_m=0.12, stoutness=1.0, radius_share=1.0, taper=0.9,
        ),
        Growth(
            per_metre=13.0, span=(0.27, 0.97), length_m=(0.78, 0.62, 0.16), length_spread=0.18,
            angle_deg=(72.0, 62.0, 45.0), angle_spread_deg=8.0, rise=0.35, hold=0.8,
            crook_deg=6.0, node_m=0.05, stoutness=0.0145, radius_share=0.62, taper=0.8,
        ),
        Growth(
            per_metre=8.0, span=(0.22, 0.95), length_m=(0.26, 0.22, 0.10), length_spread=0.45,
            angle_deg=(58.0, 52.0, 40.0), angle_spread_deg=14.0, rise=0.9, hold=0.6,
            crook_deg=7.0, node_m=0.035, stoutness=0.013, radius_share=0.7, taper=0.8,
            whorl_deg=150.0,
        ),
        Growth(
            per_metre=1.6, span=(0.3, 0.9), length_m=(0.09, 0.07, 0.05), length_spread=0.3,
            angle_deg=(60.0, 55.0, 50.0), angle_spread_deg=15.0, rise=1.0, hold=0.0,
            crook_deg=10.0, node_m=0.02, stoutness=0.02, radius_share=0.8, taper=0.7,
        ),
    ),
    leaf=LeafShape(
        stations=(0.0, 0.15, 0.38, 0.62, 0.85, 1.0), half_width=(0.0, 0.19, 0.30, 0.27, 0.12, 0.0),
        length_m=(0.048, 0.085), petiole_m=(0.012, 0.028), leaflets=1, cluster=4,
        bearing=(0.25, 0.8, 1.6, 1.8), tip_bias=0.6, droop=0.25, curl=(0.1, 0.5), fold=(0.1, 0.45),
    ),
    fruit=FruitShape(radius_m=(0.026, 0.036), stalk_m=0.02, count=16, flatness=0.88),
    colours=Colours(
        bark=(0.20, 0.155, 0.125), shoot=(0.17, 0.09, 0.06), leaf_above=(0.045, 0.115, 0.022),
        leaf_below=(0.13, 0.20, 0.10), leaf_through=(0.17, 0.30, 0.03), fruit=(0.30, 0.30, 0.06),
        fruit_cheek=(0.38, 0.02, 0.02), furrow=0.35,
    ),
    detectable=(0.73, 0.63, 0.50, 0.40),
)

OAK = Species(
    name="oak",
    trunk_radius_m=(0.046, 0.056),
    tip_radius_m=0.0026,
    lean_deg=4.0,
    forked=True,
    orders=(
        Growth(
            per_metre=0.0, span=(0.0, 1.0), length_m=(0.85, 0.85, 0.85), length_spread=0.06,
            angle_deg=(0.0, 0.0, 0.0), angle_spread_deg=0.0, rise=0.3, hold=1.0, crook_deg=5.0,
            node_m=0.12, stoutness=1.0, radius_share=1.0, taper=0.3,
        ),
        Growth(
            per_metre=16.0, span=(0.58, 1.0), length_m=(0.85, 1.0, 1.0), length_spread=0.12,
            angle_deg=(66.0, 50.0, 24.0), angle_spread_deg=9.0, rise=0.45, hold=0.7,
            crook_deg=13.0, node_m=0.075, stoutness=0.031, radius_share=0.72, taper=0.9,
        ),
        Growth(
            per_metre=7.5, span=(0.22, 0.97), length_m=(0.44, 0.38, 0.2), length_spread=0.25,
            angle_deg=(58.0, 52.0, 40.0), angle_spread_deg=12.0, rise=0.5, hold=0.5,
            crook_deg=13.0, node_m=0.05, stoutness=0.02, radius_share=0.66, taper=0.85,
        ),
        Growth(
            per_metre=4.6, span=(0.3, 0.97), length_m=(0.16, 0.13, 0.1), length_spread=0.25,
            angle_deg=(55.0, 50.0, 40.0), angle_spread_deg=12.0, rise=0.5, hold=0.3,
            crook_deg=11.0, node_m=0.035, stoutness=0.02, radius_share=0.8, taper=0.8,
        ),
    ),
    leaf=LeafShape(
        stations=(0.0, 0.09, 0.19, 0.27, 0.37, 0.46, 0.57, 0.66, 0.77, 0.86, 0.94, 1.0),
        half_width=(0.0, 0.05, 0.14, 0.075, 0.24, 0.12, 0.33, 0.18, 0.29, 0.17, 0.17, 0.0),
        length_m=(0.07, 0.12), petiole_m=(0.004, 0.010), leaflets=1, cluster=5,
        bearing=(0.02, 0.35, 1.2, 2.0), tip_bias=1.4, droop=0.15, curl=(0.0, 0.4), fold=(0.0, 0.35),
    ),
    fruit=None,
    colours=Colours(
        bark=(0.155, 0.135, 0.115), shoot=(0.16, 0.12, 0.075), leaf_above=(0.05, 0.11, 0.018),
        leaf_below=(0.11, 0.165, 0.075), leaf_through=(0.19, 0.29, 0.03), fruit=(0.1, 0.1, 0.1),
        fruit_cheek=(0.1, 0.1, 0.1), furrow=0.65,
    ),
    detectable=(0.90, 0.75, 0.50, 0.30),
)

WALNUT = Species(
    name="walnut",
    trunk_radius_m=(0.034, 0.042),
    tip_radius_m=0.0028,
    lean_deg=3.0,
    forked=True,
    orders=(
        Growth(
            per_metre=0.0, span=(0.0, 1.0), length_m=(0.78, 0.78, 0.78), length_spread=0.06,
            angle_deg=(0.0, 0.0, 0.0), angle_spread_deg=0.0, rise=0.4, hold=1.5, crook_deg=2.5,
            node_m=0.15, stoutness=1.0, radius_share=1.0, taper=0.3,
        ),
        Growth(
            per_metre=20.0, span=(0.64, 1.0), length_m=(0.95, 1.0, 1.05), length_spread=0.1,
            angle_deg=(52.0, 40.0, 16.0), angle_spread_deg=7.0, rise=0.75, hold=0.6,
            crook_deg=5.0, node_m=0.09, stoutness=0.021, radius_share=0.66, taper=0.85,
        ),
        Growth(
            per_metre=8.0, span=(0.18, 0.95), length_m=(0.5, 0.42, 0.25), length_spread=0.25,
            angle_deg=(52.0, 46.0, 38.0), angle_spread_deg=9.0, rise=1.1, hold=0.5,
            crook_deg=6.0, node_m=0.06, stoutness=0.015, radius_share=0.6, taper=0.8,
        ),
        Growth(
            per_metre=3.8, span=(0.25, 0.92), length_m=(0.16, 0.14, 0.1), length_spread=0.3,
            angle_deg=(48.0, 45.0, 40.0), angle_spread_deg=10.0, rise=1.0, hold=0.3,
            crook_deg=6.0, node_m=0.04, stoutness=0.02, radius_share=0.75, taper=0.7,
        ),
    ),
    leaf=LeafShape(
        stations=(0.0, 0.14, 0.38, 0.64, 0.87, 1.0), half_width=(0.0, 0.13, 0.21, 0.19, 0.08, 0.0),
        length_m=(0.22, 0.36), petiole_m=(0.03, 0.06), leaflets=7, cluster=2,
        bearing=(0.02, 0.35, 1.2, 1.6), tip_bias=2.0, droop=0.45, curl=(0.1, 0.5), fold=(0.05, 0.3),
    ),
    fruit=FruitShape(radius_m=(0.019, 0.025), stalk_m=0.012, count=14, flatness=1.08),
    colours=Colours(
        bark=(0.24, 0.22, 0.20), shoot=(0.12, 0.10, 0.065), leaf_above=(0.05, 0.125, 0.02),
        leaf_below=(0.10, 0.19, 0.06), leaf_through=(0.20, 0.33, 0.035), fruit=(0.10, 0.19, 0.035),
        fruit_cheek=(0.13, 0.20, 0.05), furrow=0.3,
    ),
    detectable=(0.70, 0.64, 0.47, 0.33),
)

SPECIES = {species.name: species for species in (APPLE, OAK, WALNUT)}


def species_named(name: str) -> Species:
    """Return the preset of that name.

    Raises:
        UsageError: there is no such species.
    """
    if name not in SPECIES:
        raise UsageError(f"unknown species {name!r}; choose one of {', '.join(SPECIES)}")
    return SPECIES[name]
