"""The rational approximations of GELU and of its slope in src/model/kernel.rs.

Fits `x P(x^2) / Q(x^2)` to `erf(x / sqrt 2)`, with degree 5 on [-5.25, 5.25], and to GELU's slope less
1/2, with degree 6 on [-5.5, 5.5], by least squares on Chebyshev nodes, linearised around the last
denominator and reweighted towards the largest error (Lawson), in 60 digits; prints the coefficients
and the errors before and after rounding to float32.

    pip install mpmath==1.3.0 numpy
    python tests/golden/erf.py
"""

import mpmath as m
import numpy as np

NODES, ROUNDS = 120, 25


def fit(function, limit, degree):
    """The largest error, P and Q."""
    x = [limit * (1 + m.cos(m.pi * (2 * i + 1) / (2 * NODES))) / 2 for i in range(NODES)]
    target = [function(v) for v in x]
    weights, denominators, best = [m.mpf(1)] * NODES, [m.mpf(1)] * NODES, None
    for _ in range(ROUNDS):
        size = 2 * degree + 1
        gram, moments = m.matrix(size, size), m.matrix(size, 1)
        for v, f, weight, q in zip(x, target, weights, denominators):
            powers = [v ** (2 * k) for k in range(degree + 1)]
            row = [v * p for p in powers] + [-f * p for p in powers[1:]]
            for a in range(size):
                moments[a] += weight / q**2 * row[a] * f
                for b in range(size):
                    gram[a, b] += weight / q**2 * row[a] * row[b]
        solution = list(m.lu_solve(gram, moments))
        p, q = solution[: degree + 1], [m.mpf(1)] + solution[degree + 1 :]
        value = lambda c, v: sum(c[k] * v ** (2 * k) for k in range(degree + 1))
        denominators = [value(q, v) for v in x]
        errors = [abs(v * value(p, v) / d - f) for v, d, f in zip(x, denominators, target)]
        worst = max(errors)
        if best is None or worst < best[0]:
            best = (worst, p, q)
        weights = [w * (e / worst + m.mpf("1e-3")) for w, e in zip(weights, errors)]
        total = sum(weights)
        weights = [w * NODES / total for w in weights]
    return best


def erf(x):
    return m.erf(x / m.sqrt(2))


def slope(x):
    return erf(x) / 2 + x * m.exp(-x * x / 2) / m.sqrt(2 * m.pi)


if __name__ == "__main__":
    m.mp.dps = 60
    x = np.linspace(-8, 8, 4001).astype(np.float32)
    for function, limit, degree, whole, exact in [
        (erf, "5.25", 5, lambda f: np.float32(0.5) * x * (1 + f), lambda v: v * (1 + erf(v)) / 2),
        (slope, "5.5", 6, lambda f: np.float32(0.5) + f, lambda v: m.mpf("0.5") + slope(v)),
    ]:
        error, p, q = fit(function, m.mpf(limit), degree)
        print(function.__name__, "P", [m.nstr(v, 9) for v in p])
        print(function.__name__, "Q", [m.nstr(v, 9) for v in q])
        print("largest error before rounding", m.nstr(error, 3))
        clipped = np.clip(x, -np.float32(limit), np.float32(limit))
        horner = lambda c: np.polyval([np.float32(v) for v in c][::-1], clipped * clipped)
        found = whole(clipped * horner(p) / horner(q))
        expected = np.array([float(exact(m.mpf(float(v)))) for v in x])
        print("largest error / max(1, |x|) of", "gelu" if function is erf else "its slope",
              "in float32", (np.abs(found - expected) / np.maximum(1, np.abs(x))).max())
