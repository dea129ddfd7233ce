"""Golden numbers for src/primitives/, by programs that are not ours.

    pip install numpy==2.5.5 scipy==1.18.1 scikit-learn==1.9.1 gmr==2.0.3 \
        movement_primitives==0.9.1 pytransform3d==3.17.0 dtw-python==1.9.0
    python primitives.py

dtw-python gives the warpings, scikit-learn the steps of the optimisation and the criteria of a
mixture, gmr the regressions, and movement_primitives the ProMPs and DMPs. Nobody publishes a
TP-GMM, so it is written out here from the paper's equations, with scipy's densities and gmr's
regression.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import pytransform3d.rotations as pr
from dtw import dtw
from gmr import GMM
from movement_primitives.dmp import DMP, CartesianDMP
from movement_primitives.promp import ProMP
from scipy.stats import multivariate_normal
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

HERE = Path(__file__).parent
rng = np.random.default_rng(20191030)


def rows(array):
    """Fourteen significant digits keep the files small and are more than the tests ask for."""
    array = np.asarray(array, dtype=float)
    if array.ndim == 0:
        return float(f"{array:.14g}")
    return [rows(a) for a in array]


def write(name, golden):
    text = json.dumps(golden, separators=(",", ":"))
    (HERE / f"{name}.json").write_text(text + "\n")


def curve(steps, dim, late=1.0):
    """A smooth random curve of a few harmonics, with a timing of its own."""
    s = np.linspace(0, 1, steps)[:, np.newaxis] ** late
    y = rng.normal(size=dim) + rng.normal(size=dim) * s
    for harmonic in range(1, 4):
        y = y + rng.normal(size=dim) / harmonic**2 * np.sin(np.pi * harmonic * s)
    return y


def warpings():
    cases = []
    for name, n, m, dim, window in [
        ("equal lengths", 30, 30, 2, None),
        ("a longer query", 40, 25, 3, None),
        ("a longer reference", 12, 33, 1, None),
        ("two states", 2, 9, 2, None),
        ("a narrow window", 40, 40, 2, 3),
        ("a window and other lengths", 24, 30, 2, 7),
    ]:
        query, reference = curve(n, dim, 1.4), curve(m, dim)
        for pattern in ["symmetric1", "symmetric2"]:
            band = {"window_type": "sakoechiba", "window_args": {"window_size": window}}
            found = dtw(query, reference, step_pattern=pattern, **(band if window else {}))
            cases.append(
                {
                    "name": name,
                    "pattern": pattern,
                    "window": window,
                    "query": rows(query),
                    "reference": rows(reference),
                    "distance": rows(found.distance),
                    "path": [[int(i), int(j)] for i, j in zip(found.index1, found.index2)],
                }
            )
    write("dtw", cases)


def random_covariance(dim, scale):
    root = rng.normal(size=(dim, dim)) * scale
    return root @ root.T + 0.05 * scale**2 * np.eye(dim)


def mixture(weights, means, covariances):
    return {"weights": rows(weights), "means": rows(means), "covariances": rows(covariances)}


def mixtures():
    dim, components = 3, 4
    centers = rng.normal(size=(components, dim)) * 2
    samples = np.concatenate([
        rng.multivariate_normal(c, random_covariance(dim, 0.7), size=60) for c in centers
    ])
    start_means = centers + 0.8 * rng.normal(size=centers.shape)
    start_covariances = np.array([random_covariance(dim, 1.0) for _ in range(components)])
    start_weights = np.array([0.1, 0.2, 0.3, 0.4])
    fitted = []
    warnings.simplefilter("ignore", ConvergenceWarning)
    for iterations in [1, 2, 25]:
        em = GaussianMixture(
            components, max_iter=iterations, tol=0, reg_covar=1e-6, weights_init=start_weights,
            means_init=start_means, precisions_init=np.linalg.inv(start_covariances),
        ).fit(samples)
        fitted.append({
            "iterations": iterations,
            "mixture": mixture(em.weights_, em.means_, em.covariances_),
            "mean_log_likelihood": rows(em.score(samples)),
            "bic": rows(em.bic(samples)),
        })
    regressions = []
    gmm = GMM(components, start_weights, start_means, start_covariances)
    for inputs in [1, 2]:
        for _ in range(6):
            x = rng.normal(size=inputs) * 3
            given = gmm.condition(np.arange(inputs), x).to_mvn()
            assert np.allclose(gmm.predict(np.arange(inputs), x[np.newaxis])[0], given.mean)
            regressions.append({
                "input": rows(x), "mean": rows(given.mean), "covariance": rows(given.covariance),
            })
    write("gmm", {
        "samples": rows(samples),
        "start": mixture(start_weights, start_means, start_covariances),
        "fitted": fitted,
        "regressions": regressions,
    })


def tp_gmm():
    """Calinon's tutorial (2016), section 3: joint EM over the frames, products, regression."""
    dim, steps, components, iterations, ridge = 3, 20, 5, 12, 1e-6
    motions, frames = [], []
    for _ in range(6):
        motion_frames = []
        for _ in range(2):
            q = pr.matrix_from_compact_axis_angle(rng.normal(size=3))
            motion_frames.append((q, rng.normal(size=dim)))
        shape = np.stack([np.linspace(0, 1, steps) ** 1.2, np.sin(3 * np.linspace(0, 1, steps)),
                          np.cos(2 * np.linspace(0, 1, steps))], axis=1)
        (a1, b1), (a2, b2) = motion_frames
        blend = np.linspace(0, 1, steps)[:, np.newaxis]
        motion = (1 - blend) * (shape @ a1.T + b1) + blend * (shape @ a2.T + b2)
        motions.append(motion + 0.02 * rng.normal(size=motion.shape))
        frames.append(motion_frames)
    time = np.tile(np.linspace(0, 1, steps), len(motions))
    views = []
    for j in range(2):
        local = [np.linalg.solve(f[j][0], (m - f[j][1]).T).T for m, f in zip(motions, frames)]
        views.append(np.column_stack([time, np.concatenate(local)]))
    # Equal slices of time to start with.
    slice_of = np.minimum((time * components).astype(int), components - 1)
    gamma = np.eye(components)[slice_of]
    for step in range(iterations + 1):
        if step > 0:
            density = np.stack([
                pi * np.prod([multivariate_normal(mu[i], sigma[i]).pdf(v)
                              for mu, sigma, v in zip(means, covariances, views)], axis=0)
                for i, pi in enumerate(weights)
            ], axis=1)
            gamma = density / density.sum(axis=1, keepdims=True)
        weights = gamma.mean(axis=0)
        means = [(gamma.T @ v) / gamma.sum(axis=0)[:, np.newaxis] for v in views]
        covariances = [
            np.stack([np.cov(v.T, aweights=gamma[:, i], ddof=0) + ridge * np.eye(1 + dim)
                      for i in range(components)])
            for v in views
        ]
    new_frames = [(pr.matrix_from_compact_axis_angle(rng.normal(size=3)), rng.normal(size=dim))
                  for _ in range(2)]
    product_means, product_covariances = [], []
    for i in range(components):
        precision, weighted = 0, 0
        for (a, b), mu, sigma in zip(new_frames, means, covariances):
            big_a, big_b = np.eye(1 + dim), np.zeros(1 + dim)
            big_a[1:, 1:], big_b[1:] = a, b
            own = np.linalg.inv(big_a @ sigma[i] @ big_a.T)
            precision, weighted = precision + own, weighted + own @ (big_a @ mu[i] + big_b)
        product_covariances.append(np.linalg.inv(precision))
        product_means.append(product_covariances[-1] @ weighted)
    product = GMM(components, weights, np.array(product_means), np.array(product_covariances))
    answers = [product.condition(np.array([0]), np.array([t])).to_mvn()
               for t in np.linspace(0, 1, steps)]

    def framed(pairs):
        return [{"matrix": rows(a), "origin": rows(b)} for a, b in pairs]

    write("tp_gmm", {
        "components": components,
        "iterations": iterations,
        "regularization": ridge,
        "motions": rows(motions),
        "frames": [framed(f) for f in frames],
        "new_frames": framed(new_frames),
        "product": mixture(weights, product_means, product_covariances),
        "mean": rows([a.mean for a in answers]),
        "covariance": rows([a.covariance for a in answers]),
    })


def probabilistic():
    cases = []
    for name, dim, count, steps, ridge in [("plane", 2, 10, 60, 1e-9), ("space", 3, 7, 41, 1e-3)]:
        promp = ProMP(dim, count)
        phase = np.linspace(0, 1, steps)
        motions = [curve(steps, dim) for _ in range(8)]
        weights = np.array([promp.weights(phase.copy(), m, ridge) for m in motions])
        mean, covariance = weights.mean(axis=0), np.cov(weights.T)
        promp.from_weight_distribution(mean, covariance)
        at, via, variance = 0.4, curve(2, dim)[0], 0.01
        through = promp.condition_position(via, y_cov=variance * np.eye(dim), t=at, t_max=1.0)
        cases.append({
            "name": name,
            "basis_functions": count,
            "ridge": ridge,
            "motions": rows(motions),
            "weights": rows(weights),
            "mean": rows(promp.mean_trajectory(phase.copy())),
            "variance": rows(promp.var_trajectory(phase.copy())),
            "via": {"phase": at, "state": rows(via), "variance": variance},
            "through_mean": rows(through.mean_trajectory(phase.copy())),
            "through_variance": rows(through.var_trajectory(phase.copy())),
        })
    write("promp", cases)


def dmps():
    cases = []
    for name, dim, smooth, ridge, duration in [
        ("plane", 2, False, 1e-6, 1.0),
        ("plane, smooth", 2, True, 1e-6, 1.0),
        ("space in two seconds", 3, True, 1e-3, 2.0),
    ]:
        steps = 101
        times = np.linspace(0, duration, steps)
        motion = curve(steps, dim, 1.2)
        dmp = DMP(dim, execution_time=duration, dt=duration / (steps - 1), n_weights_per_dim=12,
                  int_dt=duration / 1000, smooth_scaling=smooth)
        dmp.imitate(times, motion, regularization_coefficient=ridge)
        repeated = dmp.open_loop(step_function="euler")[1][:steps]
        start, goal = motion[0] + 0.1 * rng.normal(size=dim), motion[-1] + rng.normal(size=dim)
        dmp.configure(start_y=start, goal_y=goal)
        cases.append({
            "name": name,
            "basis_functions": 12,
            "ridge": ridge,
            "smooth_scaling": smooth,
            "motion": rows(motion),
            "weights": rows(dmp.forcing_term.weights_),
            "repeated": rows(repeated),
            "start": rows(start),
            "goal": rows(goal),
            "moved": rows(dmp.open_loop(step_function="euler")[1][:steps]),
        })
    orientations = []
    for name, smooth in [("a turn", False), ("a turn, smooth", True)]:
        steps = 101
        vectors = 0.5 * curve(steps, 3)
        quaternions = np.array([pr.quaternion_from_compact_axis_angle(v) for v in vectors])
        poses = np.hstack([curve(steps, 3), quaternions])
        dmp = CartesianDMP(execution_time=1.0, dt=0.01, n_weights_per_dim=12, int_dt=0.001,
                           smooth_scaling=smooth)
        dmp.imitate(np.linspace(0, 1, steps), poses, regularization_coefficient=1e-6)
        repeated = dmp.open_loop(quaternion_step_function="python")[1][:steps, 3:]
        turn = pr.quaternion_from_compact_axis_angle([0.3, -0.4, 0.2])
        goal = poses[-1].copy()
        goal[3:] = pr.concatenate_quaternions(turn, goal[3:])
        dmp.configure(start_y=poses[0], goal_y=goal)
        moved = dmp.open_loop(quaternion_step_function="python")[1][:steps, 3:]
        orientations.append({
            "name": name,
            "basis_functions": 12,
            "ridge": 1e-6,
            "smooth_scaling": smooth,
            "quaternions_wxyz": rows(quaternions),
            "weights": rows(dmp.forcing_term_rot.weights_),
            "repeated": rows(repeated),
            "goal": rows(goal[3:]),
            "moved": rows(moved),
        })
    write("dmp", {"vectors": cases, "orientations": orientations})


warpings()
mixtures()
tp_gmm()
probabilistic()
dmps()
