"""The rational approximation of erf in src/model/kernel.rs.

Fits `erf(x / sqrt 2) = x P(x^2) / Q(x^2)` with P and Q of degree 5 on [-5.25, 5.25] by least squares
on Chebyshev nodes, linearised around the last denominator and reweighted towards the largest error
(Lawson), in 60 digits; prints the coefficients and the errors before and after rounding to float32.

    pip install mpmath==1.3.0 numpy
    python tests/golden/erf.py
"""

from math import erf

import mpmath as m
import numpy as np

RANGE, DEGREE, NODES, ROUNDS = m.mpf("5.25"), 5, 120, 25


def fit():
    m.mp.dps = 60
    x = [RANGE * (1 + m.cos(m.pi * (2 * i + 1) / (2 * NODES))) / 2 for i in range(NODES)]
    target = [m.erf(v / m.sqrt(2)) for v in x]
    weights, denominators, best = [m.mpf(1)] * NODES, [m.mpf(1)] * NODES, None
    for _ in range(ROUNDS):
        size = 2 * DEGREE + 1
        gram, moments = m.matrix(size, size), m.matrix(size, 1)
        for v, f, weight, q in zip(x, target, weights, denominators):
            powers = [v ** (2 * k) for k in range(DEGREE + 1)]
            row = [v * p for p in powers] + [-f * p for p in powers[1:]]
            for a in range(size):
                moments[a] += weight / q**2 * row[a] * f
                for b in range(size):
                    gram[a, b] += weight / q**2 * row[a] * row[b]
        solution = list(m.lu_solve(gram, moments))
        p, q = solution[: DEGREE + 1], [m.mpf(1)] + solution[DEGREE + 1 :]
        value = lambda c, v: sum(c[k] * v ** (2 * k) for k in range(DEGREE + 1))
        denominators = [value(q, v) for v in x]
        errors = [abs(v * value(p, v) / d - f) for v, d, f in zip(x, denominators, target)]
        worst = max(errors)
        if best is None or worst < best[0]:
            best = (worst, p, q)
        weights = [w * (e / worst + m.mpf("1e-3")) for w, e in zip(weights, errors)]
        total = sum(weights)
        weights = [w * NODES / total for w in weights]
    return best


if __name__ == "__main__":
    error, p, q = fit()
    print("P", [m.nstr(v, 9) for v in p])
    print("Q", [m.nstr(v, 9) for v in q])
    print("largest error of erf before rounding", m.nstr(error, 3))
    x = np.linspace(-8, 8, 20001).astype(np.float32)
    clipped = np.clip(x, -np.float32(RANGE), np.float32(RANGE))
    horner = lambda c: np.polyval([np.float32(v) for v in c][::-1], clipped * clipped)
    gelu = np.float32(0.5) * x * (1 + clipped * horner(p) / horner(q))
    exact = np.array([0.5 * v * (1 + erf(v / 2**0.5)) for v in x.astype(float)])
    print("largest error of gelu / max(1, |x|) in float32",
          (np.abs(gelu - exact) / np.maximum(1, np.abs(x))).max())
