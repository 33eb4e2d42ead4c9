import json

import numpy as np
import pytest

from canopy_skel.confidence import (
    Logistic,
    fit_logistic,
    models_from,
    models_to,
    shipped_models,
)


def test_a_model_of_other_figures_is_refused():
    model = fit_logistic(np.eye(4), [True, False, True, False])
    with pytest.raises(ValueError, match="fitted to 4 figures, asked of 5: fit them again"):
        model(np.zeros((2, 5)))


def test_a_fitted_logistic_means_what_it_says():
    rng = np.random.default_rng(3)
    features = rng.normal(2.0, 3.0, (200000, 2))
    together = 0.05 * (features[:, 0] - 2) * (features[:, 1] - 2)
    true_p = 1 / (1 + np.exp(-(0.5 + features @ [0.4, -0.2] + together)))
    model = fit_logistic(features, rng.random(200000) < true_p)
    assert np.abs(model(features) - true_p).max() < 0.03


def test_a_row_has_the_same_probability_alone_and_among_others():
    model = Logistic(
        bias=0.1,
        linear=(0.3, 0.7),
        products=(0.2, -0.4, 0.1),
        means=(0.0, 1.0),
        scales=(1.0, 2.0),
    )
    features = np.random.default_rng(0).normal(size=(100, 2))
    alone = [model(row[None])[0] for row in features]
    assert model(features).tolist() == alone


def test_models_survive_being_written():
    models = shipped_models()
    assert models_from(json.loads(models_to(models))) == models
    assert all(one.provenance for by_depth in models.values() for one in by_depth.values())
