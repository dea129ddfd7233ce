"""Verifies published samples again, with nothing of ours: pinocchio for the kinematics, numpy for the rest.

    python3.12 -m venv .venv-verify
    .venv-verify/bin/pip install -r tests/verify/requirements.txt
    .venv-verify/bin/python tests/verify/verify.py SAMPLES.jsonl \\
        --robot config/robots/baxter.toml --task config/tasks/pour.toml [--json] [--processes 2]

Each line of SAMPLES.jsonl is {"request": {...}, "sample": {...}}. The request says what was asked for: `task`
(each location's [x, y]), `tolerance_m`, `velocity_scale`, `acceleration_scale`, `speed` (times as fast as learned;
1 without), and `start` (positions by joint, or null). The sample has the fields that `tcvae sample --json` prints.

What is checked of each sample:

    shape                all that is needed is there, in lengths that agree
    finite               no NaN, no infinity
    joint_names          the arm's joints, all of them
    times                rise strictly from above 0; those of the poses are the same
    equal_steps          the steps of the primitive are equal
    last_velocity        0
    positions            inside the limits at the points
    positions_cubic      and between them, on the cubics through positions and velocities
    positions_quintic    and on the quintics through positions, velocities and accelerations, where these are
    velocities           of the cubics, and of the quintics where these are: the limits' shares
    accelerations        the same, where the robot has limits for them
    jerks                the same inside the steps, where the robot has limits; scales leave these alone
    steps                between two points no joint moves further than its velocity limit allows
    tip_position, tip_orientation    the published poses are those that pinocchio computes
    task                 G, measured on pinocchio's poses, is within tolerance of what was asked for
    validity.*           each bound of the task, in the learned timing; those of speeds and accelerations also as
                         it is executed, where that is faster
    self_clearance, table_clearance  at the points: at least clearance_m
    self_between, table_between      at four configurations of the spline between two points: at least 0
    reported.*           what the sample says of itself agrees with what is measured here

With a start and an approach, the spline is played from there.

Links are taken as capsules about the shapes of their <collision>: a sphere, a cylinder or a capsule as its
segment with its radius (a cylinder's in full length), a box as its longest edge (the first of those) with
half the diagonal of the other two. Meshes are left out, and links that hang on joints beside the arm's.
Two links are checked against each other where at least two of the arm's joints lie between them, unless the
robot's TOML ignores them or they overlap nearly wherever the joints stand, which is then said. What is above
the table is what at least two joints move.

Exit status: 0 all is well, 1 something is violated, 2 wrong usage (or nothing to verify).
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
import time
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

# One process is one thread; --processes says how many there are.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402  (after its environment is set)
import orjson  # noqa: E402
import pinocchio  # noqa: E402

# The description of robots whose TOML names none.
BUILT_IN_URDF = Path(__file__).resolve().parents[2] / "config" / "baxter.urdf"

SUB_STEPS = 20  # of each step of the played spline
FINE_STEPS = 400  # again about the worst of them
BETWEEN = np.arange(1, 5) / 5  # where between two points clearances are measured, in steps
DEFAULT_CLEARANCE_M = 0.01
PROBES, ALWAYS = 2000, 0.95  # configurations, and the share of them in which what always touches does

ROUNDING = 1e-9  # what arithmetic may add to a length or an angle
RELATIVE = 1e-6  # share by which a limit may be exceeded, or equal steps may differ
AGREEMENT = 1e-6  # m or rad between their numbers and ours
BLOCK_BYTES = 8 << 20
AT_ONCE = 100  # configurations
MOST_LISTED = 100
MOST_PRINTED = 20


class UsageError(Exception):
    """Something in the arguments or the files that they name is not as it must be."""


# --- Robot -----------------------------------------------------------------------------------------------


def rotation_of_rpy(roll, pitch, yaw):
    """The rotation matrix of a URDF's rpy: about the fixed x, then y, then z."""
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def numbers(text, count):
    values = [float(value) for value in text.split()]
    if len(values) != count:
        raise UsageError(f"{text!r} in the URDF: {count} numbers are needed")
    return values


def known(where, table, keys):
    """What a file asks for and nobody here looks at must not pass in silence."""
    if unknown := sorted(set(table) - keys):
        raise UsageError(f"{where} has {', '.join(unknown)}, which is not understood here")


def origin(element):
    """The transform of an element's <origin>: (rotation, translation)."""
    found = element.find("origin")
    attributes = {} if found is None else found.attrib
    rotation = rotation_of_rpy(*numbers(attributes.get("rpy", "0 0 0"), 3))
    return rotation, np.array(numbers(attributes.get("xyz", "0 0 0"), 3))


def product(a, b):
    return a[0] @ b[0], a[0] @ b[1] + a[1]


def inverse(a):
    return a[0].T, -a[0].T @ a[1]


IDENTITY = (np.eye(3), np.zeros(3))


class Robot:
    """The arm from the base frame to the tip, its limits and its shape."""

    def __init__(self, path):
        config = read_toml(path)
        urdf = path.parent / config["urdf"] if "urdf" in config else BUILT_IN_URDF
        try:
            root = ElementTree.parse(urdf).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise UsageError(f"{urdf}: {error}") from error
        self.base, self.tip = config["base_frame"], config["tip_link"]
        joints = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
        self._read_chain(joints)
        if self.names != config["arm"]["joints"]:
            raise UsageError(f"{urdf} moves {self.names} between {self.base} and {self.tip}; "
                             f"{path} says {config['arm']['joints']}")
        if "joint_limits" in config:
            raise UsageError(f"{path}: joint_limits is not read here; write its limits as [limits.JOINT]")
        for name, limits in config.get("limits", {}).items():
            known(f"{path}: [limits.{name}]", limits, {"velocity", "acceleration", "jerk"})
            if name in self.names:
                j = self.names.index(name)
                self.velocity[j] = min(self.velocity[j], limits.get("velocity", np.inf))
                self.acceleration[j] = limits.get("acceleration", self.acceleration[j])
                self.jerk[j] = limits.get("jerk", self.jerk[j])
        self._read_shape(root, joints, config.get("collision", {}), path)
        self._read_pinocchio(urdf)

    def _read_chain(self, joints):
        way, link = [], self.tip
        while link != self.base:
            if link not in joints:
                raise UsageError(f"{self.tip} does not hang on {self.base}")
            way.append(joints[link])
            link = way[-1].find("parent").get("link")
        self.names, self.moves, self.fixed, self.axes, self.prismatic = [], [], [], [], []
        lower, upper, fastest = [], [], []
        before = IDENTITY
        for joint in reversed(way):
            before = product(before, origin(joint))
            kind = joint.get("type")
            if kind == "fixed":
                continue
            if kind not in ("revolute", "continuous", "prismatic") or joint.find("mimic") is not None:
                raise UsageError(f"joint {joint.get('name')} is {kind}, or mimics another one")
            axis = joint.find("axis")
            axis = np.array(numbers("1 0 0" if axis is None else axis.get("xyz"), 3))
            limit = joint.find("limit")
            bounded = kind != "continuous"
            self.names.append(joint.get("name"))
            self.moves.append(joint.find("child").get("link"))
            self.fixed.append(before)
            self.axes.append(axis / np.linalg.norm(axis))
            self.prismatic.append(kind == "prismatic")
            lower.append(float(limit.get("lower", 0)) if bounded else -np.inf)
            upper.append(float(limit.get("upper", 0)) if bounded else np.inf)
            fastest.append([float(limit.get("velocity"))]
                           + [float(limit.get(what, np.inf)) for what in ("acceleration", "jerk")])
            before = IDENTITY
        self.last_from_tip = before
        self.lower, self.upper = np.array(lower), np.array(upper)
        self.velocity, self.acceleration, self.jerk = np.array(fastest).T
        self.units = ["m" if prismatic else "rad" for prismatic in self.prismatic]

    def _read_shape(self, root, joints, collision, path):
        known(f"{path}: [collision]", collision, {"clearance_m", "table_height_m", "ignore", "parts"})
        self.clearance_m = collision.get("clearance_m", DEFAULT_CLEARANCE_M)
        self.table_m = collision.get("table_height_m")
        links = {link.get("name"): link for link in root.findall("link")}
        ignore = {frozenset(pair) for pair in collision.get("ignore", [])}
        for name in sorted({name for pair in ignore for name in pair} - set(links)):
            raise UsageError(f"{path}: [collision] ignores {name}, which is no link")
        # Each link that is rigid with the base (0) or with what the arm's k-th joint moves (k).
        rigid = {self.base: (0, IDENTITY)} | {link: (k, IDENTITY) for k, link in enumerate(self.moves, 1)}
        grown = True
        while grown:
            grown = False
            for child, joint in joints.items():
                parent = joint.find("parent").get("link")
                if joint.get("type") != "fixed" or (child in rigid) == (parent in rigid):
                    continue
                if parent in rigid:
                    k, placement = rigid[parent]
                    rigid[child] = (k, product(placement, origin(joint)))
                else:
                    k, placement = rigid[child]
                    rigid[parent] = (k, product(placement, inverse(origin(joint))))
                grown = True
        # Shapes: link, k, the segment's ends in the frame of k, radius.
        self.shapes = []
        for name, (k, placement) in sorted(rigid.items(), key=lambda item: (item[1][0], item[0])):
            for element in links[name].findall("collision"):
                capsule = capsule_of(element.find("geometry"))
                if capsule is None:
                    continue
                half, radius = capsule
                rotation, translation = product(placement, origin(element))
                ends = np.array([translation - rotation @ half, translation + rotation @ half])
                self.shapes.append((name, k, ends, radius))
        for part in collision.get("parts", []):
            known(f"{path}: [collision] parts", part, {"link", "from_m", "to_m", "radius_m"})
            if part["link"] not in rigid:
                raise UsageError(f"{path}: [collision] has a part on {part['link']}, which the arm has not")
            k, (rotation, translation) = rigid[part["link"]]
            ends = np.array([part["from_m"], part["to_m"]], dtype=float) @ rotation.T + translation
            self.shapes.append((part["link"], k, ends, part["radius_m"]))
        self.shape_links = [shape[0] for shape in self.shapes]
        self.shape_k = np.array([shape[1] for shape in self.shapes], dtype=int)
        self.ends = np.array([shape[2] for shape in self.shapes]).reshape(-1, 2, 3)
        self.radii = np.array([shape[3] for shape in self.shapes])
        pairs = [
            (a, b)
            for b in range(len(self.shapes))
            for a in range(b)
            if abs(self.shape_k[a] - self.shape_k[b]) >= 2
            and frozenset((self.shape_links[a], self.shape_links[b])) not in ignore
        ]
        self.pairs = np.array(pairs, dtype=int).reshape(-1, 2)
        over_table = [] if self.table_m is None else np.flatnonzero(self.shape_k >= 2)
        self.over_table = np.array(over_table, dtype=int)
        self._leave_out_what_always_touches()

    def _leave_out_what_always_touches(self):
        """Shapes that overlap nearly wherever the joints stand are so by construction."""
        self.left_out = []
        if not len(self.pairs):
            return
        lower, upper = np.maximum(self.lower, -math.pi), np.minimum(self.upper, math.pi)
        anywhere = np.random.default_rng(1).uniform(lower, upper, (PROBES, len(self.names)))
        apart, _ = self.clearances(self.placements(anywhere)[0])
        touching = (apart < 0).mean(axis=1)
        for share, (a, b) in zip(touching, self.pairs):
            if share > ALWAYS:
                self.left_out.append((self.shape_links[a], self.shape_links[b], float(share)))
        self.pairs = self.pairs[touching <= ALWAYS]

    def _read_pinocchio(self, urdf):
        """The same description as pinocchio reads it, with all joints but the arm's locked."""
        whole = pinocchio.buildModelFromUrdf(str(urdf))
        locked = [whole.getJointId(name) for name in whole.names[1:] if name not in self.names]
        self.model = pinocchio.buildReducedModel(whole, locked, pinocchio.neutral(whole))
        self.data = self.model.createData()
        pinocchio.framesForwardKinematics(self.model, self.data, pinocchio.neutral(self.model))
        base = self.data.oMf[self.model.getFrameId(self.base)]
        self.world_from_base = base.rotation.copy(), base.translation.copy()
        self.tip_frame = self.model.getFrameId(self.tip)

    def tip_poses(self, q):
        """By pinocchio: the tip in the base frame, (rotations [N, 3, 3], positions [N, 3])."""
        model, data, frame = self.model, self.data, self.tip_frame
        configurations = np.empty((len(q), model.nq))
        for j, name in enumerate(self.names):
            joint = model.joints[model.getJointId(name)]
            if joint.nq == 1:
                configurations[:, joint.idx_q] = q[:, j]
            else:  # a continuous joint, as cosine and sine
                configurations[:, joint.idx_q] = np.cos(q[:, j])
                configurations[:, joint.idx_q + 1] = np.sin(q[:, j])
        rotations, positions = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
        for i, configuration in enumerate(configurations):
            pinocchio.framesForwardKinematics(model, data, configuration)
            placement = data.oMf[frame]
            rotations[i], positions[i] = placement.rotation, placement.translation
        base_rotation, base_position = self.world_from_base
        return base_rotation.T @ rotations, (positions - base_position) @ base_rotation

    def placements(self, q):
        """For many configurations at once: the frames of what each joint moves, and the tip's.

        Only links between the base and the tip need it, for which pinocchio has no call on many
        configurations. That both agree is asserted at every point.
        """
        count = len(q)
        rotation, position = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        frames = [(rotation, position)]
        for j, (fixed_rotation, fixed_position) in enumerate(self.fixed):
            position = position + rotation @ fixed_position
            rotation = rotation @ fixed_rotation
            axis, value = self.axes[j], q[:, j]
            if self.prismatic[j]:
                position = position + (rotation @ axis) * value[:, None]
            else:
                x, y, z = axis
                cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                sin, cos = np.sin(value)[:, None, None], np.cos(value)[:, None, None]
                rotation = rotation @ (np.eye(3) + sin * cross + (1 - cos) * (cross @ cross))
            frames.append((rotation, position))
        tip = rotation @ self.last_from_tip[0], position + rotation @ self.last_from_tip[1]
        return frames, tip

    def clearances(self, frames):
        """Distances [pairs, N] of the pairs, and [shapes over the table, N] to the table."""
        starts = np.empty((3, len(self.shapes), len(frames[0][1])))
        ways = np.empty_like(starts)
        for i, k in enumerate(self.shape_k):
            rotation, position = frames[k]
            start, end = self.ends[i]
            starts[:, i] = (position + rotation @ start).T
            ways[:, i] = (rotation @ (end - start)).T
        a, b = self.pairs.T
        apart = np.empty((len(self.pairs), starts.shape[2]))
        # In parts that a processor's cache holds.
        for first in range(0, starts.shape[2], AT_ONCE):
            part = slice(first, first + AT_ONCE)
            of = [values[..., part][:, shapes] for shapes in (a, b) for values in (starts, ways)]
            apart[:, part] = segment_distances(*of)
        apart -= (self.radii[a] + self.radii[b])[:, None]
        height = (starts[2] + np.minimum(ways[2], 0))[self.over_table] - self.radii[self.over_table, None]
        return apart, height - (self.table_m or 0.0)


def capsule_of(geometry):
    """Half of the segment, as a vector from its middle, and the radius; None for a mesh."""
    shape = geometry[0]
    match shape.tag:
        case "sphere":
            return np.zeros(3), float(shape.get("radius"))
        case "cylinder" | "capsule":
            return np.array([0, 0, 0.5 * float(shape.get("length"))]), float(shape.get("radius"))
        case "box":
            size = np.array(numbers(shape.get("size"), 3))
            longest = int(np.argmax(size))
            half = np.zeros(3)
            half[longest] = 0.5 * size[longest]
            return half, 0.5 * float(np.linalg.norm(np.delete(size, longest)))
        case "mesh":
            return None
        case other:
            raise UsageError(f"<{other}> in a <collision> of the URDF")


def segment_distances(a, u, b, v):
    """Distances between the segments from a to a + u and from b to b + v, each [3, ...].

    The nearest points are either an end of one segment and a point of the other, of which there are four
    cases, or the feet of the common perpendicular where both lie inside.
    """

    def dot(p, q):
        return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]

    w = a - b
    uu, vv, uv, uw, vw, ww = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w), dot(w, w)

    def to_segment(offset, along, square, inverse):
        """Squared distance of a point to a segment: its offset from the start, squared and along it."""
        share = np.clip(along * inverse, 0, 1)
        return offset - share * (2 * along - share * square)

    inverse_uu, inverse_vv = 1 / np.maximum(uu, 1e-30), 1 / np.maximum(vv, 1e-30)
    least = to_segment(ww, vw, vv, inverse_vv)
    for candidate in (
        to_segment(ww + 2 * uw + uu, vw + uv, vv, inverse_vv),
        to_segment(ww, -uw, uu, inverse_uu),
        to_segment(ww - 2 * vw + vv, uv - uw, uu, inverse_uu),
    ):
        np.minimum(least, candidate, out=least)
    determinant = uu * vv - uv * uv
    determinant[determinant <= 1e-12 * uu * vv] = np.nan
    s, t = (uv * vw - vv * uw) / determinant, (uu * vw - uv * uw) / determinant
    inside = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    s, t = s[inside], t[inside]
    perpendicular = ww[inside] + s * (s * uu[inside] + 2 * uw[inside] - 2 * t * uv[inside])
    perpendicular += t * (t * vv[inside] - 2 * vw[inside])
    least[inside] = np.minimum(least[inside], perpendicular)
    return np.sqrt(np.maximum(least, 0))


# --- Task ------------------------------------------------------------------------------------------------

INTERVALS = {
    "action_start_secs": "s", "action_duration_secs": "s", "duration_secs": "s", "lift_m": "m",
    "end_height_m": "m", "arrival_height_m": "m", "workspace_x_m": "m", "workspace_y_m": "m",
    "workspace_z_m": "m",
}
MAXIMA = {
    "max_tilt_deg": "degrees", "max_end_tilt_deg": "degrees", "max_sink_m": "m", "max_speed_m_per_s": "m/s",
    "max_turn_deg_per_s": "degrees/s", "max_acceleration_m_per_s2": "m/s2",
}
RATES = {"max_speed_m_per_s", "max_turn_deg_per_s", "max_acceleration_m_per_s2"}


class Task:
    """What a pour is, where it is measured, and what makes it valid."""

    def __init__(self, path):
        config = read_task(path)
        action = config.get("action", {})
        if config.get("task") != "manipulation" or action.get("kind") != "tilt":
            raise UsageError(f"{path}: only tasks whose action is a tilt can be verified")
        self.above_deg, self.same_above_deg = action["above_deg"], action["same_above_deg"]
        self.locations = [(location["name"], location["at"]) for location in config["locations"]]
        self.validity = config["validity"]
        known(f"{path}: [validity]", self.validity, set(INTERVALS) | set(MAXIMA))

    def pour(self, rotations, positions):
        return Pour(self, rotations, positions)


class Pour:
    """What the poses of a primitive show; times are in steps."""

    def __init__(self, task, rotations, positions):
        self.positions = positions
        cup_axis = rotations[0].T @ np.array([0.0, 0.0, 1.0])
        up = np.clip((rotations @ cup_axis)[:, 2], -1, 1)
        self.tilts = np.degrees(np.arccos(up))
        self.intervals = above(self.tilts, task.above_deg)
        self.steps = sum(end - start for start, end in self.intervals)
        self.happens = self.steps > 0
        # Intervals with no lower tilt between them are one pour.
        self.last_of_first, self.count = 0, 1
        for (_, end), (start, _) in zip(self.intervals, self.intervals[1:]):
            between = self.tilts[math.ceil(end) : math.floor(start) + 1]
            if between.min(initial=180.0) < task.same_above_deg:
                self.count += 1
            elif self.count == 1:
                self.last_of_first += 1
        self.mean = self._mean() if self.happens else np.full(3, np.nan)

    def at(self, when):
        """The position at fractional steps, [len(when), 3]."""
        steps = np.arange(len(self.positions))
        return np.stack([np.interp(when, steps, self.positions[:, axis]) for axis in range(3)], axis=1)

    def _mean(self):
        """Mean position over the time of pouring, straight between two points."""
        total = np.zeros(3)
        for start, end in self.intervals:
            knots = np.concatenate([[start], np.arange(math.floor(start) + 1, math.ceil(end)), [end]])
            total += np.trapezoid(self.at(knots), knots, axis=0)
        return total / self.steps

    def locations(self, task):
        """G: each location's (x, y)."""
        places = {"start": self.positions[0], "action": self.mean, "end": self.positions[-1]}
        return {name: places[at][:2] for name, at in task.locations}

    def measures(self, rotations, step_secs):
        """Each quantity that may be bounded: (lowest, highest)."""
        positions, tilts = self.positions, self.tilts
        values = {
            "duration_secs": (len(positions) - 1) * step_secs,
            "end_height_m": positions[-1, 2] - positions[0, 2],
            "max_tilt_deg": tilts.max(),
            "max_end_tilt_deg": tilts[-1],
            "max_sink_m": positions[0, 2] - positions[:, 2].min(),
            "max_speed_m_per_s": norms(np.diff(positions, axis=0)).max(initial=0) / step_secs,
            "max_acceleration_m_per_s2":
                norms(np.diff(positions, 2, axis=0)).max(initial=0) / step_secs**2,
            "max_turn_deg_per_s":
                np.degrees(angles(rotations[:-1], rotations[1:])).max(initial=0) / step_secs,
        }
        if self.happens:
            end = self.intervals[self.last_of_first][1]
            values |= {
                "action_start_secs": self.intervals[0][0] * step_secs,
                "action_duration_secs": self.steps * step_secs,
                "lift_m": self.mean[2] - positions[0, 2],
                "arrival_height_m": self.at([end])[0, 2] - positions[-1, 2],
            }
        ranges = {name: (value, value) for name, value in values.items()}
        for axis, name in enumerate("xyz"):
            ranges[f"workspace_{name}_m"] = (positions[:, axis].min(), positions[:, axis].max())
        return ranges


def above(values, threshold):
    """Where values, straight between their steps, are above a threshold: [(start, end)] in steps."""
    is_above = values > threshold
    changes = np.flatnonzero(is_above[1:] != is_above[:-1])
    crossings = changes + (threshold - values[changes]) / (values[changes + 1] - values[changes])
    ends = list(map(float, crossings))
    if is_above[0]:
        ends.insert(0, 0.0)
    if is_above[-1]:
        ends.append(len(values) - 1.0)
    return list(zip(ends[::2], ends[1::2]))


def norms(vectors):
    return np.linalg.norm(vectors, axis=-1)


def angles(a, b):
    """Angles between rotation matrices, [N, 3, 3] each; accurate where they are small, too."""
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / (2 * math.sqrt(2))
    return 2 * np.arcsin(np.clip(chord, 0, 1))


def read_toml(path):
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path}: {error}") from error


def read_task(path, depth=0):
    """A task's TOML, on top of those that it is based on."""
    own = read_toml(path)
    if "based_on" not in own:
        return own
    if depth == 8:
        raise UsageError(f"{path}: too many files are based on each other")
    return merged(read_task(path.parent / own.pop("based_on"), depth + 1), own)


def merged(base, own):
    both = dict(base)
    for key, value in own.items():
        old = both.get(key)
        both[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return both


# --- The played spline -----------------------------------------------------------------------------------


class Spline:
    """Polynomials in the share of each step: coefficients [steps, joints, degree + 1]."""

    def __init__(self, times, positions, velocities, accelerations=None):
        self.times, self.h = times, np.diff(times)[:, None]
        p, step = positions[:-1], np.diff(positions, axis=0)
        v0, v1 = self.h * velocities[:-1], self.h * velocities[1:]
        if accelerations is None:
            parts = [p, v0, 3 * step - 2 * v0 - v1, v0 + v1 - 2 * step]
        else:
            a0, a1 = (0.5 * self.h**2 * a for a in (accelerations[:-1], accelerations[1:]))
            parts = [
                p, v0, a0,
                10 * step - 6 * v0 - 4 * v1 - 3 * a0 + a1,
                -15 * step + 8 * v0 + 7 * v1 + 3 * a0 - 2 * a1,
                6 * step - 3 * v0 - 3 * v1 - a0 + a1,
            ]
        self.coefficients = np.stack(parts, axis=-1)

    def derivative(self, order):
        """Coefficients of a derivative by time."""
        result = self.coefficients
        for _ in range(order):
            result = result[..., 1:] * np.arange(1, result.shape[-1]) / self.h[:, :, None]
        return result

    def at(self, shares, order=0):
        """Values [steps, joints, shares]."""
        return evaluate(self.derivative(order), shares)

    def largest(self, order, badness):
        """Of each joint the value where badness(value [steps, joints, shares]) is largest, and the time."""
        coefficients = self.derivative(order)
        shares = np.linspace(0, 1, SUB_STEPS + 1)
        bad = badness(evaluate(coefficients, shares))
        # Again, finely, about the worst place of each joint.
        joint = np.arange(bad.shape[1])
        worst = bad.max(axis=2).argmax(axis=0)
        near = shares[bad[worst, joint].argmax(axis=1)][:, None]
        fine = np.clip(near + np.linspace(-1, 1, FINE_STEPS + 1) / SUB_STEPS, 0, 1)
        powers = fine[..., None] ** np.arange(coefficients.shape[-1])
        values = np.einsum("jsc,jc->js", powers, coefficients[worst, joint])
        bad = badness(values[None])[0]
        at = bad.argmax(axis=1)
        times = self.times[worst] + fine[joint, at] * self.h[worst, 0]
        return values[joint, at], bad[joint, at], times


def evaluate(coefficients, shares):
    return coefficients @ np.power.outer(shares, np.arange(coefficients.shape[-1])).T


# --- One sample ------------------------------------------------------------------------------------------


class Malformed(Exception):
    """A sample lacks something that its checks need. The arguments: check, what is wrong."""


class Findings:
    """The outcome of each check of a sample: (excess, violated, value, limit, unit, where)."""

    def __init__(self):
        self.of = {}

    def note(self, check, excess, value, limit, unit, where, allowed=0.0):
        """`excess` says by how much the limit is broken, in one measure for the whole check."""
        violated = not excess <= allowed
        excess = math.inf if math.isnan(excess) else float(excess)
        finding = (excess, violated, float(value), float(limit), unit, where)
        old = self.of.get(check)
        if old is None or (violated, excess) > (old[1], old[0]):
            self.of[check] = finding

    def at_most(self, check, value, limit, unit, where, allowed=0.0):
        self.note(check, value - limit, value, limit, unit, where, allowed)

    def at_least(self, check, value, limit, unit, where, allowed=0.0):
        self.note(check, limit - value, value, limit, unit, where, allowed)


def array(values, *shape):
    """Numbers of a shape, where -1 is any length; null is NaN."""
    try:
        result = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise Malformed("shape", "values that are no numbers, or of lengths that differ") from error
    expected = tuple(n if m == -1 else m for n, m in zip(result.shape, shape))
    if len(result.shape) != len(shape) or result.shape != expected:
        raise Malformed("shape", f"values of shape {result.shape}, expected {shape}")
    return result


class Sample:
    """The numbers of a line, as arrays in the arm's order of joints."""

    def __init__(self, robot, task, line):
        try:
            entry = orjson.loads(line)
            self._read(robot, task, entry["request"], entry["sample"])
        except orjson.JSONDecodeError as error:
            raise Malformed("shape", f"no JSON: {error}") from error
        except (KeyError, TypeError, AttributeError, IndexError) as error:
            raise Malformed("shape", f"{type(error).__name__}: {error}") from error

    def _read(self, robot, task, request, sample):
        trajectory = sample["joint_trajectory"]
        names = trajectory["joint_names"]
        if sorted(names) != sorted(robot.names):
            raise Malformed("joint_names", f"{names}")
        order = [names.index(name) for name in robot.names]
        points, dof = trajectory["points"], len(robot.names)
        if len(points) < 2:
            raise Malformed("shape", f"{len(points)} points")

        def of_points(key):
            return array([point[key] for point in points], len(points), dof)[:, order]

        self.times = array([point["time_from_start"] for point in points], -1)
        self.positions, self.velocities = of_points("positions"), of_points("velocities")
        given = sum(bool(point.get("accelerations")) for point in points)
        if given not in (0, len(points)):
            raise Malformed("shape", f"{given} of {len(points)} points have accelerations")
        self.accelerations = of_points("accelerations") if given else None

        poses = sample["end_effector_trajectory"]["points"]
        if len(poses) != len(points):
            raise Malformed("shape", f"{len(points)} points and {len(poses)} poses")
        self.pose_times = array([pose["time_from_start"] for pose in poses], -1)
        transforms = [pose["transforms"][0] for pose in poses]
        translations, rotations = ([t[part] for t in transforms] for part in ("translation", "rotation"))
        self.tip_positions = array([[t["x"], t["y"], t["z"]] for t in translations], -1, 3)
        self.tip_quaternions = array([[r["x"], r["y"], r["z"], r["w"]] for r in rotations], -1, 4)

        self.primitive = sample["primitive_start_index"]
        if not (isinstance(self.primitive, int) and 0 <= self.primitive <= len(points) - 2):
            raise Malformed("shape", f"primitive_start_index {self.primitive} of {len(points)} points")
        reported = {location["name"]: location["point"] for location in sample["empirical_task"]}
        at = [reported[name] for name, _ in task.locations]
        self.empirical_task = array([[point["x"], point["y"]] for point in at], -1, 2)
        self.asked_task = array([request["task"][name] for name, _ in task.locations], -1, 2)
        keys = ("task_error", "joint_margin", "slowdown")
        self.task_error, self.joint_margin, self.slowdown = array([sample[key] for key in keys], 3)
        clearance = sample["min_clearance"]
        self.min_clearance = None if clearance is None else array([clearance], 1)[0]
        keys = ("tolerance_m", "velocity_scale", "acceleration_scale")
        self.tolerance_m, self.velocity_scale, self.acceleration_scale = array([request[k] for k in keys], 3)
        self.speed = array([request.get("speed", 1.0)], 1)[0]
        start = request.get("start")
        self.start = None if start is None else array([start[name] for name in robot.names], dof)
        if not (self.slowdown >= 1 and self.tolerance_m > 0 and self.velocity_scale > 0
                and self.acceleration_scale > 0 and self.speed > 0):
            raise Malformed("shape", "a slowdown below 1, or a tolerance, a scale or a speed that is not above 0")

    def arrays(self):
        return {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, (float, np.ndarray)) and value is not None
        }


def verify(robot, task, line):
    """All findings of one line."""
    findings = Findings()
    try:
        sample = Sample(robot, task, line)
    except Malformed as malformed:
        check, what = malformed.args
        findings.note(check, math.inf, math.nan, math.nan, "", what)
        return findings
    for check in ("shape", "joint_names"):
        findings.note(check, 0, 0, 0, "", "")
    for name, values in sample.arrays().items():
        count = np.count_nonzero(~np.isfinite(values))
        findings.at_most("finite", count, 0, "values", name)
    if findings.of["finite"][1]:
        return findings
    rising = check_times(sample, findings)
    findings.at_most("last_velocity", np.abs(sample.velocities[-1]).max(), 0, "rad/s", "last point", ROUNDING)
    spline = check_spline(robot, sample, findings) if rising else None
    rotations, positions = check_tip(robot, sample, findings)
    check_task(task, sample, rotations[sample.primitive :], positions[sample.primitive :], findings)
    margin = np.minimum(sample.positions - robot.lower, robot.upper - sample.positions).min()
    agree(findings, "reported.joint_margin", sample.joint_margin, margin, "rad")
    check_collisions(robot, sample, spline, findings)
    return findings


def agree(findings, check, reported, measured, unit, where=""):
    """The finding's value is what was reported, its limit what was measured."""
    difference = 0.0 if reported == measured else abs(reported - measured)
    findings.note(check, difference, reported, measured, unit, where, AGREEMENT)


def at_point(sample, i):
    return f"points[{i}] (t = {sample.times[i]:.3f} s)"


def check_times(sample, findings):
    """Whether times rise, so that there is a spline at all."""
    times = sample.times
    steps = np.diff(times, prepend=0)
    i = int(steps.argmin())
    # Strictly: not even an equal time is allowed.
    where = f"before {at_point(sample, i)}"
    findings.note("times", -steps[i], steps[i], 0, "s", where, -sys.float_info.min)
    differences = np.abs(times - sample.pose_times)
    i = int(differences.argmax())
    if differences[i] > ROUNDING:
        where = f"pose of {at_point(sample, i)}"
        findings.note("times", differences[i], sample.pose_times[i], times[i], "s", where, ROUNDING)
    steps = np.diff(times[sample.primitive :])
    relative = np.abs(steps / steps.mean() - 1)
    i = int(relative.argmax())
    where = at_point(sample, i + sample.primitive)
    findings.note("equal_steps", relative[i], steps[i], steps.mean(), "s", where, RELATIVE)
    return bool((np.diff(times, prepend=0) > 0).all())


def check_spline(robot, sample, findings):
    """The spline that a controller plays; with an approach from a start, from there on.

    A controller may leave accelerations aside, so cubics must be within the limits in any case.
    """
    times, positions = sample.times, sample.positions
    velocities, accelerations = sample.velocities, sample.accelerations
    beyond = np.maximum(robot.lower - positions, positions - robot.upper)
    note_joints(robot, findings, "positions", positions, beyond, times, (robot.lower, robot.upper), ROUNDING)
    if sample.start is not None and sample.primitive > 0:
        at_rest = np.zeros((1, len(robot.names)))
        times = np.concatenate([[0.0], times])
        positions = np.concatenate([sample.start[None], positions])
        velocities = np.concatenate([at_rest, velocities])
        accelerations = None if accelerations is None else np.concatenate([at_rest, accelerations])

    def outside(values):
        lower, upper = robot.lower[:, None], robot.upper[:, None]
        return np.maximum(lower - values, values - upper)

    played = cubic = Spline(times, positions, velocities)
    splines = {"positions_cubic": cubic}
    if accelerations is not None:
        played = splines["positions_quintic"] = Spline(times, positions, velocities, accelerations)
    for check, spline in splines.items():
        values, bad, when = spline.largest(0, outside)
        note_joints(robot, findings, check, values, bad, when, (robot.lower, robot.upper), ROUNDING)

    limits = [("velocities", 1, robot.velocity * sample.velocity_scale)]
    if np.isfinite(robot.acceleration).any():
        limits.append(("accelerations", 2, robot.acceleration * sample.acceleration_scale))
    if np.isfinite(robot.jerk).any():
        limits.append(("jerks", 3, robot.jerk))
    for check, order, limit in limits:
        for spline in splines.values():
            values, bad, when = spline.largest(order, lambda values: np.abs(values) / limit[:, None])
            unit = ("/s", "/s2", "/s3")[order - 1]
            note_joints(robot, findings, check, values, bad - 1, when, (-limit, limit), RELATIVE, unit)

    steps, allowed = np.diff(positions, axis=0), np.diff(times)[:, None] * robot.velocity
    bad = np.abs(steps) / allowed - 1
    i, j = np.unravel_index(bad.argmax(), bad.shape)
    where = f"{robot.names[j]} from t = {times[i]:.3f} s to {times[i + 1]:.3f} s"
    findings.note("steps", bad[i, j], abs(steps[i, j]), allowed[i, j], robot.units[j], where, RELATIVE)
    return played


def note_joints(robot, findings, check, values, bad, times, limits, allowed, unit=""):
    """The worst of values [..., joints], by how bad they are, at times [..., joints] or [...]."""
    i = np.unravel_index(bad.argmax(), bad.shape)
    j = i[-1]
    value, when = values[i], times[i] if times.shape == values.shape else times[i[:-1]]
    lower, upper = limits[0][j], limits[1][j]
    limit = lower if lower - value > value - upper else upper
    where = f"{robot.names[j]} at t = {when:.3f} s"
    findings.note(check, bad[i], value, limit, robot.units[j] + unit, where, allowed)


def check_tip(robot, sample, findings):
    """The tip by pinocchio, against what was published."""
    rotations, positions = robot.tip_poses(sample.positions)
    off = norms(positions - sample.tip_positions)
    i = int(off.argmax())
    findings.at_most("tip_position", off[i], AGREEMENT, "m", at_point(sample, i))
    x, y, z, w = (sample.tip_quaternions / norms(sample.tip_quaternions)[:, None]).T
    published = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], axis=-1).reshape(-1, 3, 3)
    # A quaternion that is no rotation counts as one that is turned as far as its length is off.
    off = np.maximum(angles(rotations, published), np.abs(norms(sample.tip_quaternions) - 1))
    i = int(off.argmax())
    findings.at_most("tip_orientation", off[i], AGREEMENT, "rad", at_point(sample, i))
    return rotations, positions


def check_task(task, sample, rotations, positions, findings):
    """G, what it is asked to be near to, and the bounds of a valid motion."""
    pour = task.pour(rotations, positions)
    reached = pour.locations(task)
    if not pour.happens:
        where = f"the tilt reaches {pour.tilts.max():.1f} of {task.above_deg} degrees"
        findings.note("task", math.inf, math.nan, sample.tolerance_m, "m", where)
        return
    errors = []
    for (name, _), asked, reported in zip(task.locations, sample.asked_task, sample.empirical_task):
        errors.append(math.dist(reached[name], asked))
        findings.at_most("task", errors[-1], sample.tolerance_m, "m", name, ROUNDING)
        for axis, ours, theirs in zip("xy", reached[name], reported):
            agree(findings, "reported.empirical_task", theirs, ours, "m", f"{name}.{axis}")
    agree(findings, "reported.task_error", sample.task_error, max(errors), "m")

    times = sample.times[sample.primitive :]
    executed_secs = (times[-1] - times[0]) / (len(times) - 1)
    step_secs = executed_secs / sample.slowdown * sample.speed
    findings.at_most("validity.actions", pour.count, 1, "times", "")
    ranges = pour.measures(rotations, step_secs) if step_secs > 0 else {}
    if 0 < executed_secs < step_secs:
        ranges |= {name: range for name, range in pour.measures(rotations, executed_secs).items() if name in RATES}
    for name, bound in task.validity.items():
        low, high = ranges.get(name, (math.nan, math.nan))
        unit = INTERVALS.get(name) or MAXIMA[name]
        upper = bound["upper"] if name in INTERVALS else bound
        slack = RELATIVE * max(1.0, abs(upper))
        findings.at_most(f"validity.{name}", high, upper, unit, "", slack)
        if name in INTERVALS:
            findings.at_least(f"validity.{name}", low, bound["lower"], unit, "", slack)


def check_collisions(robot, sample, spline, findings):
    """Clearances at the points, and at four configurations between each two."""
    frames, tip = robot.placements(sample.positions)
    by_pinocchio = robot.tip_poses(sample.positions[[0, -1]])
    if not (np.allclose(tip[0][[0, -1]], by_pinocchio[0], atol=ROUNDING)
            and np.allclose(tip[1][[0, -1]], by_pinocchio[1], atol=ROUNDING)):
        raise AssertionError("verify.py and pinocchio disagree about where the tip is")
    least = math.inf
    if len(robot.pairs) or len(robot.over_table):
        names = ["self_clearance", "table_clearance"]
        least = note_clearances(robot, frames, sample.times, names, robot.clearance_m, findings)
        if spline is not None:
            between = spline.at(BETWEEN).transpose(0, 2, 1).reshape(-1, len(robot.names))
            times = (spline.times[:-1, None] + spline.h * BETWEEN).ravel()
            frames, _ = robot.placements(between)
            note_clearances(robot, frames, times, ["self_between", "table_between"], 0.0, findings)
    if sample.min_clearance is not None:
        agree(findings, "reported.min_clearance", sample.min_clearance, least, "m")


def note_clearances(robot, frames, times, names, needed, findings):
    """The smallest of all clearances."""
    least = math.inf
    for name, distances in zip(names, robot.clearances(frames)):
        if distances.size == 0:
            continue
        j, i = np.unravel_index(distances.argmin(), distances.shape)
        if name.startswith("self"):
            a, b = (robot.shape_links[k] for k in robot.pairs[j])
        else:
            a, b = robot.shape_links[robot.over_table[j]], "the table"
        where = f"{a} and {b} at t = {times[i]:.3f} s"
        findings.at_least(name, distances[j, i], needed, "m", where, ROUNDING)
        least = min(least, float(distances[j, i]))
    return least


# --- Files of samples ------------------------------------------------------------------------------------


class Summary:
    """What was found in many samples."""

    def __init__(self):
        self.samples, self.violated_samples = 0, 0
        self.checks = {}  # by name: [samples checked, violations, worst finding, its line]
        self.listed = []

    def add(self, line_number, findings):
        self.samples += 1
        violated = False
        for name, finding in findings.of.items():
            self._count(name, 1, int(finding[1]), finding, line_number)
            if finding[1]:
                violated = True
                self.listed.append((line_number, name, finding))
        self.violated_samples += violated

    def _count(self, name, checked, violations, finding, line_number):
        entry = self.checks.setdefault(name, [0, 0, finding, line_number])
        entry[0] += checked
        entry[1] += violations
        if (finding[1], finding[0]) > (entry[2][1], entry[2][0]):
            entry[2:] = [finding, line_number]

    def join(self, other, lines_before):
        """Adds the summary of a later block of lines."""
        self.samples += other.samples
        self.violated_samples += other.violated_samples
        for name, (checked, violations, finding, line) in other.checks.items():
            self._count(name, checked, violations, finding, line + lines_before)
        listed = [(line + lines_before, name, finding) for line, name, finding in other.listed]
        self.listed = (self.listed + listed)[:MOST_LISTED]


_robot = _task = None


def _start(robot, task):
    global _robot, _task
    _robot, _task = Robot(robot), Task(task)


def _verify_block(block):
    path, start, end = block
    summary, lines = Summary(), 0
    with open(path, "rb") as file:
        file.seek(start)
        while file.tell() < end:
            line = file.readline()
            lines += 1
            if line.strip():
                summary.add(lines, verify(_robot, _task, line))
    summary.listed = summary.listed[:MOST_LISTED]
    return summary, lines


def blocks(path):
    """(path, start, end) of parts of a file that end where a line does."""
    size, start = os.path.getsize(path), 0
    with open(path, "rb") as file:
        while start < size:
            file.seek(min(start + BLOCK_BYTES, size))
            file.readline()
            end = file.tell()
            yield path, start, end
            start = end


def verify_file(path, robot, task, processes):
    summary, lines = Summary(), 0
    with multiprocessing.Pool(processes, _start, (robot, task)) as pool:
        for part, part_lines in pool.imap(_verify_block, blocks(path)):
            summary.join(part, lines)
            lines += part_lines
    return summary


def number(value):
    """JSON has neither NaN nor infinity."""
    return value if math.isfinite(value) else None


def as_json(summary, robot, secs):
    def finding_json(line, finding):
        _, violated, value, limit, unit, where = finding
        return {
            "line": line, "violated": violated, "value": number(value), "limit": number(limit), "unit": unit,
            "where": where,
        }

    checks = [
        {"name": name, "checked": checked, "violations": violations, "worst": finding_json(line, finding)}
        for name, (checked, violations, finding, line) in summary.checks.items()
    ]
    listed = [{"check": name} | finding_json(line, finding) for line, name, finding in summary.listed]
    return {
        "samples": summary.samples, "violated_samples": summary.violated_samples, "secs": secs,
        "checks": checks, "violations": listed, "always_touching": robot.left_out,
    }


def told(finding):
    _, _, value, limit, unit, where = finding
    if not unit:
        return where
    text = f"{value:.9g} {unit}, limit {limit:.9g}"
    return f"{text}; {where}" if where else text


def print_summary(summary, robot, secs):
    for a, b, share in robot.left_out:
        print(f"not held apart, as they overlap in {100 * share:.1f} % of configurations: {a} and {b}")
    for line, name, finding in summary.listed[:MOST_PRINTED]:
        print(f"line {line}: {name}: {told(finding)}")
    hidden = sum(entry[1] for entry in summary.checks.values()) - MOST_PRINTED
    if hidden > 0:
        print(f"and {hidden} more")
    print(f"{'check':36} {'checked':>8} {'violated':>8}  worst")
    for name, (checked, violations, finding, line) in summary.checks.items():
        worst = told(finding)
        print(f"{name:36} {checked:8} {violations:8}  {worst}{f' (line {line})' if worst else ''}")
    samples, violated = summary.samples, summary.violated_samples
    print(f"{samples} samples, {violated} with a violation; {secs:.1f} s, {samples / secs:.0f}/s")


def main(arguments=None):
    parser = argparse.ArgumentParser(description="Verifies published samples without tcvae.")
    parser.add_argument("samples", type=Path, help="one {request, sample} a line")
    parser.add_argument("--robot", type=Path, required=True, help="the robot's TOML")
    parser.add_argument("--task", type=Path, required=True, help="the task's TOML")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args(arguments)
    start = time.perf_counter()
    try:
        # Here too, so that what is wrong with them is said once.
        try:
            robot, _ = Robot(arguments.robot), Task(arguments.task)
        except (KeyError, ValueError, AttributeError) as error:
            reason = f"{arguments.robot} or {arguments.task}: {type(error).__name__}: {error}"
            raise UsageError(reason) from error
        if not arguments.samples.is_file() or arguments.samples.stat().st_size == 0:
            raise UsageError(f"{arguments.samples}: no samples")
        summary = verify_file(arguments.samples, arguments.robot, arguments.task, arguments.processes)
        if summary.samples == 0:
            raise UsageError(f"{arguments.samples}: no samples")
    except UsageError as error:
        print(f"verify.py: {error}", file=sys.stderr)
        return 2
    secs = time.perf_counter() - start
    if arguments.json:
        print(json.dumps(as_json(summary, robot, secs)))
    else:
        print_summary(summary, robot, secs)
    return 1 if summary.violated_samples else 0


if __name__ == "__main__":
    sys.exit(main())
