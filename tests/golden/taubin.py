"""Golden numbers for the Taubin circle fit, from the PyPI package circle-fit's SVD form.

    pip install circle-fit==0.2.1 && python taubin.py > taubin.json
"""

import json

import numpy as np
from circle_fit import taubinSVD

rng = np.random.default_rng(20190901)

# name: points, start and span in degrees, centre, radius, standard deviation of the noise
CASES = {
    "a noiseless arc of 270 degrees": (32, 10, 270, (0.3, 0.8), 0.4, 0.0),
    "a noiseless arc of 90 degrees": (32, 170, 90, (0.9, 0.1), 0.2, 0.0),
    "a noisy arc of 60 degrees": (32, 30, 60, (0.5, 0.5), 0.5, 0.01),
    "another noisy arc of 60 degrees": (100, 200, 60, (0.5, 0.5), 0.3, 0.01),
    "a very noisy arc of 60 degrees": (32, 75, 60, (0.2, 0.7), 0.4, 0.03),
    "a noisy arc of 20 degrees": (50, 0, 20, (0.0, 0.0), 1.0, 0.001),
    "a clockwise arc": (32, 120, -200, (0.1, 0.2), 0.35, 0.005),
    "a full circle": (64, 0, 354, (0.5, 0.4), 0.25, 0.02),
    "three points": (3, 0, 120, (0.5, 0.5), 0.3, 0.0),
    "far from the origin": (32, 45, 150, (1e4, -2e4), 0.3, 0.005),
    "large": (32, 45, 150, (1e4, -2e4), 3e3, 40.0),
    "a blob": (40, 0, 354, (0.0, 0.0), 0.05, 0.1),
}

golden = []
for name, (count, start, span, center, radius, noise) in CASES.items():
    angles = np.radians(start + span * np.arange(count) / (count - 1))
    points = np.asarray(center) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points += noise * rng.standard_normal(points.shape)
    x, y, r, sigma = (float(v) for v in taubinSVD(points))
    golden.append(
        {
            "name": name,
            "points": points.tolist(),
            "center": [x, y],
            "radius": r,
            "rms_residual": sigma,
        }
    )

print(json.dumps(golden, indent=None, separators=(",", ":")).replace('{"name"', '\n{"name"'))
