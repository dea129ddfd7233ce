"""Which of the requests that were refused could have been served, as TRAC-IK sees it.

    target/release/tcvae check models/pouring.safetensors --count 2000 --refused refused.jsonl --json > check.json
    .venv-peers/bin/python benches/peers/feasible.py refused.jsonl check.json [--robot config/robots/baxter.toml]

`tcvae check` says itself which requests could be followed, by its own inverse kinematics. Here TRAC-IK says so of each
request that was refused: whether one of the motions that it may be answered with (20 draws of the manner) has at
every point a configuration inside the limits and clear of itself and the table, each point on its own, from up to
STARTS starts with random restarts inside each. Limits and distances are those of tests/verify, which shares
nothing with the Rust code. That a path exists does not follow, so the share that is told is a lower bound.

The environment is that of ik.py.
"""

import argparse
import json
import multiprocessing
import os
import sys
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np  # noqa: E402  (after its environment is set)

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "verify"))
import verify  # noqa: E402

STARTS = 10
TIMEOUT_SECS = 0.005
POSITION_M, ORIENTATION_RAD = 1e-3, 1e-2


class Solver:
    def __init__(self, robot_file):
        import pytracik

        self.robot = verify.Robot(robot_file)
        urdf = verify.BUILT_IN_URDF.read_text()
        self.solve = pytracik.ik
        kind = pytracik.SolveType.Speed
        self.trac_ik = pytracik.TRAC_IK(self.robot.base, self.robot.tip, urdf, TIMEOUT_SECS, 1e-5, kind)

    def reaches(self, q, pose):
        """Whether q is inside the limits, clear of everything, and has the tip there, by numpy alone."""
        robot = self.robot
        if (q < robot.lower).any() or (q > robot.upper).any():
            return False
        frames, (rotation, position) = robot.placements(q[None])
        if np.linalg.norm(position[0] - pose[:3]) > POSITION_M:
            return False
        x, y, z, w = pose[3:]
        wished = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])
        cosine = (np.trace(wished.T @ rotation[0]) - 1) / 2
        if np.arccos(np.clip(cosine, -1, 1)) > ORIENTATION_RAD:
            return False
        apart, height = robot.clearances(frames)
        return min(apart.min(initial=np.inf), height.min(initial=np.inf)) >= robot.clearance_m

    def configuration(self, pose, seed, rng):
        for start in range(STARTS):
            q = seed if start == 0 else rng.uniform(self.robot.lower, self.robot.upper)
            answer = self.solve(self.trac_ik, np.asarray(q), *pose)
            if answer[0] >= 0 and self.reaches(np.array(answer[1:]), np.array(pose)):
                return np.array(answer[1:])
        return None

    def follows(self, path, rng):
        """Whether each pose can be taken; those that are furthest apart are looked at first."""
        coarse = list(range(0, len(path), 10))
        order = coarse + [i for i in range(len(path)) if i not in set(coarse)]
        found = {}
        for i in order:
            near = min(found, key=lambda j: abs(j - i), default=None)
            seed = (self.robot.lower + self.robot.upper) / 2 if near is None else found[near]
            q = self.configuration(path[i], seed, rng)
            if q is None:
                return False
            found[i] = q
        return True


def judge(line):
    request = json.loads(line)
    rng = np.random.default_rng(request["seed"])
    feasible = any(solver.follows(path, rng) for path in request["paths"])
    return {"seed": request["seed"], "code": request["code"], "ours": request["could_be_followed"],
            "tracik": feasible}


def start(robot_file):
    global solver
    solver = Solver(robot_file)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("refused", type=Path)
    parser.add_argument("check", type=Path, help="what tcvae check --json printed")
    parser.add_argument("--robot", type=Path, default=ROOT / "config" / "robots" / "baxter.toml")
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    served = json.loads(arguments.check.read_text())["served"]
    with arguments.refused.open() as lines, multiprocessing.Pool(
        arguments.processes, start, (arguments.robot,)
    ) as pool:
        judged = list(pool.imap_unordered(judge, lines))
    judged.sort(key=lambda request: request["seed"])
    feasible = sum(request["tracik"] for request in judged)
    answer = {
        "served": served,
        "refused": len(judged),
        "refused_but_feasible": feasible,
        "refused_but_feasible_by_tcvae_check": sum(request["ours"] for request in judged),
        "served_fraction": served / (served + feasible),
        "seeds": [request["seed"] for request in judged if request["tracik"]],
    }
    if arguments.json:
        print(json.dumps(answer, indent=2))
    else:
        print(f"{len(judged)} refused, of which TRAC-IK finds {feasible} feasible (tcvae check: "
              f"{answer['refused_but_feasible_by_tcvae_check']}); served of all feasible ones: "
              f"{served} of {served + feasible} ({answer['served_fraction']:.4f})")


if __name__ == "__main__":
    main()
