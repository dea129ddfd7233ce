"""Inverse kinematics of Baxter's left arm beside other programs': the same poses and paths, in the same run.

Poses are those of configurations drawn evenly from inside the limits; every solver begins at the middle of
the joints' ranges. One is solved where pinocchio's forward kinematics, not the solver's word, has the tip
within 1 mm and 0.01 rad with all joints inside their limits.

Paths are pours of 100 points in 5 s. The peers go from point to point, each from the solution of the one
before; the first point is tried from up to 64 starts. A path is feasible where TRAC-IK or optik, from up to
20 starts each, or one of the rows below reaches every single pose. It is complete where every point is
solved; continuous where besides no joint moves further from point to point than 0.5 rad and 8 times what its
velocity limit allows (what is further is a jump to another branch, and not a path); and in time where it keeps
the velocity limits without being slowed down.

All of it is on one core. TRAC-IK has two threads that share it, so it gets twice the time. Times are those of
the calls alone, of all feasible paths; peers pay their Python bindings, and pinocchio's loop and pink are
Python all through.

    python3.12 -m venv .venv-peers
    .venv-peers/bin/pip install -r tests/verify/requirements.txt pytracik==0.0.3 optik-py==0.5.0 \\
        ikpy==4.2.1 pin-pink==4.4.0 qpsolvers==4.13.0 quadprog==0.1.14
    cargo build --release --example peer_ik
    .venv-peers/bin/python benches/peers/ik.py [--poses 2000] [--paths 300] [--quick] [--json] \\
        [--ours target/release/examples/peer_ik]

A peer that is not installed is left out with a word.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[variable] = "1"
warnings.simplefilter("ignore")

import numpy as np  # noqa: E402  (after its environment is set)
import pinocchio  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
URDF = ROOT / "config" / "baxter.urdf"
BASE, TIP = "base", "left_gripper"
POSITION_M, ORIENTATION_RAD = 1e-3, 1e-2
LIMIT_RAD = 1e-6  # beyond a limit; TRAC-IK keeps limits in single precision
TIMEOUT_SECS = 0.005
STARTS = 64
FEASIBLE_STARTS = 20
PINK_STEP_SECS = 0.05
SLOWDOWN, LARGEST_STEP_RAD = 8, 0.5  # what a continuous path may have to be slowed down by, and its largest step


class Arm:
    """The arm by pinocchio."""

    def __init__(self, joint_names):
        whole = pinocchio.buildModelFromUrdf(str(URDF))
        others = [whole.getJointId(name) for name in whole.names[1:] if name not in joint_names]
        self.model = pinocchio.buildReducedModel(whole, others, pinocchio.neutral(whole))
        assert list(self.model.names[1:]) == joint_names
        self.data = self.model.createData()
        self.tip = self.model.getFrameId(TIP)
        base = self.model.frames[self.model.getFrameId(BASE)].placement
        assert base.isIdentity(), "the base is the description's root"
        self.lower, self.upper = self.model.lowerPositionLimit, self.model.upperPositionLimit
        self.velocity = self.model.velocityLimit
        self.middle = 0.5 * (self.lower + self.upper)

    def tip_pose(self, q):
        pinocchio.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.tip]

    def solves(self, q, target):
        """Whether q is finite, inside the limits, and has the tip at the target."""
        if q is None or not np.isfinite(q).all():
            return False
        if (q < self.lower - LIMIT_RAD).any() or (q > self.upper + LIMIT_RAD).any():
            return False
        tip = self.tip_pose(q)
        turn = np.linalg.norm(pinocchio.log3(target.rotation.T @ tip.rotation))
        return np.linalg.norm(tip.translation - target.translation) < POSITION_M and turn < ORIENTATION_RAD

    def anywhere(self, rng):
        return rng.uniform(self.lower, self.upper)


# --- Peers -----------------------------------------------------------------------------------------------
# Each has a name, takes a target in its own form (`prepared`), and returns a configuration or None.


class TracIk:
    def __init__(self, arm, kind="Speed"):
        import pytracik

        self.name = f"pytracik 0.0.3 (TRAC-IK), {kind}, 10 ms"
        self.call = pytracik.ik
        kind = getattr(pytracik.SolveType, kind)
        self.solver = pytracik.TRAC_IK(BASE, TIP, URDF.read_text(), 2 * TIMEOUT_SECS, 1e-5, kind)

    def prepared(self, target):
        return [*target.translation.tolist(), *pinocchio.Quaternion(target.rotation).coeffs().tolist()]

    def solve(self, target, seed, rng):
        answer = self.call(self.solver, seed, *target)
        return answer[1:] if answer[0] >= 0 else None


class Optik:
    def __init__(self, arm, mode="speed"):
        import optik

        self.name = f"optik-py 0.5.0, {mode}, 5 ms"
        # It gets fixed joints before the first moving one wrong (its forward kinematics differs from
        # everybody's by centimetres), so its chain begins after them, and targets are given from there.
        mount = "left_arm_mount"
        frame = arm.model.frames[arm.model.getFrameId(mount)]
        assert frame.parentJoint == 0
        self.mount_from_base = frame.placement.inverse()
        self.robot = optik.Robot.from_urdf_file(str(URDF), mount, TIP)
        self.robot.set_parallelism(1)
        self.limits = self.robot.joint_limits()
        # The squared error at which it stops: a tenth of a millimetre.
        self.config = optik.SolverConfig(solution_mode=mode, max_time=TIMEOUT_SECS, tol_f=1e-8)

    def prepared(self, target):
        return (self.mount_from_base * target).homogeneous.tolist()

    def solve(self, target, seed, rng):
        # A seed beyond a limit, by whatever little, would end the program.
        answer = self.robot.ik(self.config, target, np.clip(seed, *self.limits).tolist())
        return None if answer is None else np.array(answer[0])


class Clik:
    """Closed-loop inverse kinematics, as pinocchio's examples have it, with clamping and restarts."""

    def __init__(self, arm, restarts=20):
        self.name = f"pinocchio 3.9.0 CLIK, clamped, {restarts} restarts"
        self.arm, self.restarts = arm, restarts

    def prepared(self, target):
        return target

    def solve(self, target, seed, rng):
        arm, start = self.arm, seed
        for _ in range(self.restarts + 1):
            q = start.copy()
            for _ in range(100):
                error = pinocchio.log6(arm.tip_pose(q).actInv(target)).vector
                if error @ error < 1e-8:
                    return q
                jacobian = pinocchio.computeFrameJacobian(arm.model, arm.data, q, arm.tip)
                damped = jacobian @ jacobian.T + 1e-4 * np.eye(6)
                step = jacobian.T @ np.linalg.solve(damped, error)
                q = np.clip(q + step, arm.lower, arm.upper)
            start = arm.anywhere(rng)
        return None


class Ikpy:
    def __init__(self, arm):
        from ikpy.chain import Chain

        self.name = "ikpy 4.2.1"
        links = ["base", "torso_t0", "torso", "left_torso_arm_mount", "left_arm_mount"]
        self.chain = Chain.from_urdf_file(str(URDF), base_elements=links)
        names = [link.name for link in self.chain.links]
        self.active = [name in arm.model.names for name in names]
        assert [name for name in names if name in arm.model.names] == list(arm.model.names[1:])
        self.chain = Chain.from_urdf_file(str(URDF), base_elements=links, active_links_mask=self.active)
        self.active = np.flatnonzero(self.active)

    def prepared(self, target):
        return target.translation, target.rotation

    def solve(self, target, seed, rng):
        start = np.zeros(len(self.chain.links))
        start[self.active] = seed
        answer = self.chain.inverse_kinematics(
            target[0], target[1], orientation_mode="all", initial_position=start
        )
        return answer[self.active]


class Pink:
    """Differential inverse kinematics by quadratic programs, for paths alone."""

    def __init__(self, arm):
        import pink
        import quadprog  # noqa: F401  (so that its lack is known here)

        self.name = "pin-pink 4.4.0, quadprog"
        self.pink, self.arm = pink, arm
        self.task = pink.tasks.FrameTask(TIP, position_cost=1.0, orientation_cost=1.0)
        self.posture = pink.tasks.PostureTask(cost=1e-4)
        self.posture.set_target(arm.middle)

    def prepared(self, target):
        return target

    def solve(self, target, seed, rng):
        limits = self.arm.lower + 1e-6, self.arm.upper - 1e-6
        try:
            configuration = self.pink.Configuration(self.arm.model, self.arm.data, np.clip(seed, *limits))
            self.task.set_target(target)
            for _ in range(100):
                # Inside the position limits and, in each of its steps, the velocity limits.
                tasks = [self.task, self.posture]
                velocity = self.pink.solve_ik(configuration, tasks, PINK_STEP_SECS, solver="quadprog")
                configuration.integrate_inplace(velocity, PINK_STEP_SECS)
                error = self.task.compute_error(configuration)
                if error @ error < 1e-7:
                    break
        except (self.pink.exceptions.PinkError, ValueError):
            return None
        return configuration.q


def installed(makers, arm):
    peers = []
    for maker, arguments in makers:
        try:
            peers.append(maker(arm, *arguments))
        except ImportError as error:
            print(f"left out: {maker.__name__} ({error})", file=sys.stderr)
    return peers


# --- Poses -----------------------------------------------------------------------------------------------


def clocked(call, *arguments):
    """What a call returns, and its milliseconds."""
    start = time.perf_counter()
    answer = call(*arguments)
    return answer, 1e3 * (time.perf_counter() - start)


def pose(values):
    return pinocchio.XYZQUATToSE3(np.array(values))


def configuration(values):
    return None if values is None else np.array(values)


def poses(arm, ours, seed):
    """Rows: name, share solved, mean and median milliseconds."""
    entries = ours["poses"]
    targets = [pose(entry["pose"]) for entry in entries]
    rows = []

    def row(name, solutions, times):
        solved = sum(map(arm.solves, solutions, targets))
        rows.append((name, solved / len(targets), statistics.mean(times), statistics.median(times)))

    row("ours", [configuration(e["solution"]) for e in entries], [e["ms"] for e in entries])
    for peer in installed([(TracIk, ()), (Optik, ()), (Clik, ()), (Ikpy, ())], arm):
        rng = np.random.default_rng(seed)
        prepared = [peer.prepared(target) for target in targets]
        for target in prepared[:20]:
            peer.solve(target, arm.middle, rng)
        solutions, times = zip(*(clocked(peer.solve, target, arm.middle, rng) for target in prepared))
        row(peer.name, solutions, times)
        print(f"poses: {peer.name} done", file=sys.stderr)
    return rows


# --- Paths -----------------------------------------------------------------------------------------------


class Outcome:
    """What a solver makes of a path."""

    def __init__(self, arm, path, positions, ms, step_secs):
        self.ms = ms
        self.complete = positions is not None and all(map(arm.solves, positions, path))
        self.continuous = self.in_time = False
        if self.complete:
            steps = np.abs(np.diff(positions, axis=0))
            largest = arm.velocity * step_secs * (1 + 1e-6)
            self.continuous = bool((steps <= SLOWDOWN * largest).all() and steps.max() <= LARGEST_STEP_RAD)
            self.in_time = bool((steps <= largest).all())


def follow(arm, peer, path, rng):
    """Each point from the one before: positions or None, and milliseconds."""
    total, q = 0.0, arm.middle
    positions = []
    for i, target in enumerate(path):
        prepared, seed = peer.prepared(target), q
        for _ in range(STARTS if i == 0 else 1):
            q, ms = clocked(peer.solve, prepared, seed, rng)
            total += ms
            if found := arm.solves(q, target):
                break
            seed = arm.anywhere(rng)
        if not found:
            return None, total
        positions.append(q)
    return np.array(positions), total


def is_feasible(arm, solvers, path, rng):
    """Whether every pose, for itself, is reached from one of some starts."""
    last = arm.middle
    for target in path:
        prepared = [(solver, solver.prepared(target)) for solver in solvers]
        for start in range(FEASIBLE_STARTS):
            seed = last if start == 0 else arm.anywhere(rng)
            answers = (solver.solve(values, seed, rng) for solver, values in prepared)
            found = next((q for q in answers if arm.solves(q, target)), None)
            if found is not None:
                last = found
                break
        else:
            return False
    return True


def paths(arm, ours, seed, quick):
    """By kind: paths, feasible ones, and rows of name, complete, continuous, in time, mean and median milliseconds."""
    entries, step_secs = ours["paths"], ours["step_secs"]
    targets = [[pose(values) for values in entry["poses"]] for entry in entries]

    def told(solution, ms):
        return [
            Outcome(arm, path, configuration(entry[solution]), entry[ms], step_secs)
            for entry, path in zip(entries, targets)
        ]

    outcomes = {
        "ours": told("solution", "ms"),
        "ours, one pose after the other": told("stepped", "stepped_ms"),
    }
    makers = [(TracIk, ()), (Optik, ()), (Clik, ()), (Pink, ())]
    if not quick:
        makers += [(TracIk, ("Distance",)), (Optik, ("quality",))]
    for peer in installed(makers, arm):
        rng = np.random.default_rng(seed)
        outcomes[peer.name] = [
            Outcome(arm, path, *follow(arm, peer, path, rng), step_secs) for path in targets
        ]
        print(f"paths: {peer.name} done", file=sys.stderr)
    rng = np.random.default_rng(seed)
    solvers = installed([(TracIk, ()), (Optik, ())], arm)
    feasible = [
        any(of[i].complete for of in outcomes.values()) or is_feasible(arm, solvers, path, rng)
        for i, path in enumerate(targets)
    ]
    by_kind = {}
    for kind in dict.fromkeys(entry["kind"] for entry in entries):
        of_kind = [i for i, entry in enumerate(entries) if entry["kind"] == kind]
        counted = [i for i in of_kind if feasible[i]]
        rows = []
        for name, of in outcomes.items():
            times = [of[i].ms for i in counted] or [float("nan")]
            counts = [sum(getattr(of[i], what) for i in counted) for what in ("complete", "continuous", "in_time")]
            rows.append((name, *counts, statistics.mean(times), statistics.median(times)))
        followed = sum(any(of[i].continuous for of in outcomes.values()) for i in counted)
        by_kind[kind] = {"paths": len(of_kind), "feasible": len(counted), "continuous": followed, "rows": rows}
    return by_kind


def print_tables(single, count, by_kind):
    print(f"{count} poses:\n")
    print("| solver | solved | mean ms | median ms |\n|---|---|---|---|")
    for name, share, mean, median in single:
        print(f"| {name} | {100 * share:.2f} % | {mean:.3f} | {median:.3f} |")
    print("\nPours of 100 points in 5 s:\n")
    print("| kind | solver | complete | continuous | in time | mean ms | median ms |")
    print("|---|---|---|---|---|---|---|")
    for kind, of in by_kind.items():
        title = f"{kind}: {of['feasible']} of {of['paths']} feasible, {of['continuous']} continuous by any"
        for name, complete, continuous, in_time, mean, median in of["rows"]:
            print(f"| {title} | {name} | {complete} | {continuous} | {in_time} | {mean:.2f} | {median:.2f} |")
            title = ""


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--ours", type=Path, default=ROOT / "target" / "release" / "examples" / "peer_ik")
    parser.add_argument("--poses", type=int, default=2000)
    parser.add_argument("--paths", type=int, default=300, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    helped = "without the peers that use up their time at each point, which takes some 20 minutes"
    parser.add_argument("--quick", action="store_true", help=helped)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    command = [arguments.ours, *map(str, (arguments.poses, arguments.paths, arguments.seed))]
    ours = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    arm = Arm(ours["joint_names"])
    single = poses(arm, ours, arguments.seed)
    by_kind = paths(arm, ours, arguments.seed, arguments.quick)
    if arguments.json:
        print(json.dumps({"poses": single, "paths": by_kind}))
    else:
        print_tables(single, len(ours["poses"]), by_kind)


if __name__ == "__main__":
    main()
