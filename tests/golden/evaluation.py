"""Golden numbers for the evaluation: Wilson's interval from statsmodels; held-out R2 of random forests
on planted leaks, and DCI and MIG of planted factors, from scikit-learn.

    pip install scikit-learn==1.9.1 statsmodels numpy && python evaluation.py > evaluation.json
"""

import json
import math

import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.inspection import permutation_importance
from sklearn.metrics import mutual_info_score, r2_score
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


def manner_and_factors(kind, i):
    """Manner (4 values) and factors (3 values) of case i."""
    u = [uniform(8 * i + k) for k in range(8)]
    v = u[0:3]
    noise = [0.1 * (u[k] - 0.5) for k in range(3, 6)]
    if kind == "separate":
        h = [v[1] + noise[0], -v[0] + noise[1], v[2] ** 2, u[6]]
    elif kind == "mixed":
        h = [0.8 * v[0] - 0.6 * v[1], 0.6 * v[0] + 0.8 * v[1] + noise[0], v[2], u[6]]
    elif kind == "shared":
        h = [v[0] + v[1] + v[2], u[5], u[6], u[7]]
    return h, v


def concentration(shares):
    """One minus the entropy of the shares in units of the largest possible."""
    total = shares.sum()
    if total <= 0:
        return 0.0
    p = shares[shares > 0] / total
    return float(1 + (p * np.log(p)).sum() / np.log(len(shares)))


def bins(values, count=10):
    """Bins of equally many values."""
    ordered = np.sort(values)
    edges = [ordered[i * len(values) // count] for i in range(1, count)]
    return np.searchsorted(edges, values, side="right")


def disentanglement(kind):
    rows = [manner_and_factors(kind, i) for i in range(3000)]
    h = np.array([r[0] for r in rows])
    v = np.array([r[1] for r in rows])
    importance, informativeness, gaps = [], [], []
    for j in range(3):
        model = RandomForestRegressor(50, min_samples_leaf=5, random_state=0).fit(h[:2000], v[:2000, j])
        informativeness.append(max(0.0, float(r2_score(v[2000:, j], model.predict(h[2000:])))))
        lost = permutation_importance(model, h[2000:], v[2000:, j], n_repeats=5, random_state=0)
        shares = np.maximum(lost.importances_mean, 0)
        importance.append(shares / shares.sum())
        factor = bins(v[2000:, j])
        told = sorted((mutual_info_score(bins(h[2000:, i]), factor) for i in range(4)), reverse=True)
        gaps.append((told[0] - told[1]) / mutual_info_score(factor, factor))
    importance = np.array(importance).T
    weights = importance.sum(axis=1)
    return {
        "informativeness": informativeness,
        "disentanglement": float(sum(w * concentration(row) for w, row in zip(weights, importance)) / weights.sum()),
        "completeness": float(np.mean([concentration(column) for column in importance.T])),
        "mig": float(np.mean(gaps)),
    }


print(
    json.dumps(
        {
            "wilson": [
                {"hits": hits, "cases": cases, "interval": proportion_confint(hits, cases, method="wilson")}
                for hits, cases in [(8, 10), (0, 20), (950, 1000), (1000, 1000), (41, 42)]
            ],
            "leak_r2": {leak: forest(leak) for leak in ["none", "linear", "folded", "product"]},
            "disentanglement": {kind: disentanglement(kind) for kind in ["separate", "mixed", "shared"]},
        },
        indent=1,
    )
)
