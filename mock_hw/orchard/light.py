"""The light of one scan: sun, sky, haze, exposure; drawn at random, or given."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import FloatArray
from mock_hw.orchard.species import Rgb


@dataclass(frozen=True, kw_only=True, slots=True)
class Light:
    """Sun, sky, air and camera settings, the same for all views of a scan.

    sun_azimuth_deg: where the sun stands, from +x (behind the tree) to +y; 180 = behind
    the camera. sun, sky, horizon: linear radiances. cloud: -0.3 clear … 0.5 overcast. haze_m:
    distance at which 63 % is haze. flash: strength of a lamp at the camera. exposure: of the
    camera. white: gain of the red and the blue channel (white balance off by as much).
    """

    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun: Rgb
    sky: Rgb
    horizon: Rgb
    cloud: float
    haze_m: float
    flash: float
    exposure: float
    white: tuple[float, float]

    def sun_direction(self) -> FloatArray:
        """Return the (3,) unit vector towards the sun, in base."""
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        flat = np.cos(elevation)
        return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def fair_weather() -> Light:
    """Return a clear afternoon with the sun behind the camera's left shoulder."""
    return Light(
        sun_azimuth_deg=140.0,
        sun_elevation_deg=48.0,
        sun=(3.0, 2.75, 2.35),
        sky=(0.32, 0.52, 0.95),
        horizon=(0.80, 0.90, 1.05),
        cloud=0.0,
        haze_m=90.0,
        flash=0.0,
        exposure=1.0,
        white=(1.0, 1.0),
    )


def any_weather(rng: np.random.Generator) -> Light:
    """Draw weather, time of day and camera settings."""
    overcast = float(np.clip(rng.beta(0.8, 1.2), 0, 1))
    elevation = float(rng.uniform(22, 68))
    low = np.clip((50 - elevation) / 40, 0, 1)
    strength = 3.1 * (1 - 0.93 * overcast)
    sun = strength * np.array([1.0, 0.93 - 0.14 * low, 0.80 - 0.32 * low])
    grey = 0.75 * overcast
    sky = (1 - grey) * np.array([0.30, 0.50, 0.95]) + grey * np.array([0.92, 0.95, 1.0])
    horizon = (1 - grey) * np.array([0.82, 0.90, 1.03]) + grey * np.array([0.95, 0.97, 1.0])
    brightness = 0.6 * sun[1] + sky[1] + horizon[1]
    return Light(
        sun_azimuth_deg=float(rng.uniform(-180, 180)),
        sun_elevation_deg=elevation,
        sun=_rgb(sun),
        sky=_rgb(sky),
        horizon=_rgb(horizon),
        cloud=-0.15 + 0.6 * overcast,
        haze_m=float(rng.uniform(40, 150)),
        flash=float(rng.uniform(0.3, 1.2)) if rng.random() < 0.15 else 0.0,
        exposure=float(2.9 / brightness * np.exp(rng.normal(0, 0.18))),
        white=(float(np.exp(rng.normal(0, 0.05))), float(np.exp(rng.normal(0, 0.05)))),
    )


def _rgb(values: FloatArray) -> Rgb:
    r, g, b = (float(value) for value in values)
    return r, g, b
