"""Golden numbers for the evaluation: Wilson's interval from statsmodels, and held-out R2 of random
forests on planted leaks from scikit-learn.

    pip install scikit-learn==1.9.1 statsmodels numpy && python evaluation.py > evaluation.json
"""

import json
import math

import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.metrics import r2_score
from statsmodels.stats.proportion import proportion_confint

MASK = (1 << 64) - 1


def uniform(index):
    """The `index`-th number of SplitMix64 from seed 0, in [0, 1); the Rust test draws the same."""
    z = ((index + 1) * 0x9E3779B97F4A7C15) & MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return ((z ^ (z >> 31)) >> 11) * 2.0**-53


def row(leak, i):
    """Manner (3 values) and task (2 values) of case i."""
    u = [uniform(8 * i + k) for k in range(8)]
    w = u[0:2]
    noise = [u[k] - 0.5 for k in range(2, 5)]
    if leak == "none":
        h = noise
    elif leak == "linear":
        h = [w[0] + noise[0], noise[1], noise[2]]
    elif leak == "folded":
        h = [math.sin(2 * math.pi * w[0]) + 0.2 * noise[0], (w[0] - w[1]) ** 2, noise[2]]
    elif leak == "product":
        # Neither value of the manner alone says anything of the task.
        sign = 1.0 if noise[0] > 0 else -1.0
        h = [sign, sign * (w[1] - 0.5) + 0.1 * noise[1], noise[2]]
    return h, w


def forest(leak):
    rows = [row(leak, i) for i in range(6000)]
    h = np.array([r[0] for r in rows])
    w = np.array([r[1] for r in rows])
    scores = []
    for component in range(2):
        model = RandomForestRegressor(100, min_samples_leaf=20, random_state=0)
        model.fit(h[:5000], w[:5000, component])
        scores.append(float(r2_score(w[5000:, component], model.predict(h[5000:]))))
    return scores


print(
    json.dumps(
        {
            "wilson": [
                {"hits": hits, "cases": cases, "interval": proportion_confint(hits, cases, method="wilson")}
                for hits, cases in [(8, 10), (0, 20), (950, 1000), (1000, 1000), (41, 42)]
            ],
            "leak_r2": {leak: forest(leak) for leak in ["none", "linear", "folded", "product"]},
        },
        indent=1,
    )
)
