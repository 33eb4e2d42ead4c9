"""The network that tells wood pixels from leaves: what it learns, and that it is written whole."""

import json

import numpy as np

from canopy_skel.woodpixels import pixel_model_from, pixel_model_to
from service.pixelfit import fit_pixels


def test_the_pixel_model_learns_what_is_not_linear_and_is_written_as_it_is():
    random = np.random.default_rng(5)
    figures = random.normal(2.0, 3.0, (60000, 3)).astype(np.float32)
    wood = (np.abs(figures[:, 0] - 2) > 3) & (figures[:, 1] > 0)
    lesson = (figures, wood, np.ones(60000, np.float32))
    model = fit_pixels(*lesson, "noise")
    hidden = np.maximum(figures @ model.first + model.first_bias, 0)
    odds = hidden @ model.second + model.second_bias
    rows = np.column_stack([figures, np.ones(60000)])
    linear = rows @ np.linalg.lstsq(rows, wood.astype(float))[0]
    wrong, wrong_linear = ((odds > 0) != wood).mean(), ((linear > 0.5) != wood).mean()
    assert wrong < 0.5 * wrong_linear
    assert pixel_model_to(fit_pixels(*lesson, "noise")) == pixel_model_to(model)
    again = pixel_model_from(json.loads(pixel_model_to(model)))
    assert np.allclose(again.first, model.first, rtol=1e-5)
