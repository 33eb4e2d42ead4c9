import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from canopy_skel.kernels import MODULES
from service.kernels import compile_modules

sys.path.insert(0, str(Path(__file__).parent))

# Numba alone would go on with kernels whose callees have changed since.
compile_modules(MODULES)

# Kernels are compiled on first use, so single examples may be slow once.
settings.register_profile(
    "canopy", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("canopy")

SHARED_RECORDINGS = Path(__file__).parents[1] / "../shared/data/recordings"


@pytest.fixture
def shared_recording():
    """A function from a name to one of the shared orchard recordings."""

    def find(name):
        path = SHARED_RECORDINGS / f"{name}.mcap"
        if not path.exists():
            pytest.skip(f"{name}.mcap is not here: it lies in shared/data beside the project")
        return path

    return find
