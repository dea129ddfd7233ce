"""What a trajectory pours, computed from nothing but the robot description and the task's definition.

Kinematics, tilt and pour location are written here a second time, in numpy, so that a test of a
trajectory does not trust the program that made it.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
BAXTER = ROOT / "config" / "baxter.urdf"
POURING_DEG = 70.0


def rotation_of_rpy(roll, pitch, yaw):
    """Fixed axes x, y, z, as URDF has them."""
    (cr, sr), (cp, sp), (cy, sy) = [(np.cos(a), np.sin(a)) for a in (roll, pitch, yaw)]
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def rotation_about(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


class Arm:
    """The joints from the base to the tip, with their limits."""

    def __init__(self, urdf=BAXTER, base="base", tip="left_gripper"):
        by_child = {j.find("child").get("link"): j for j in ElementTree.parse(urdf).iter("joint")
                    if j.find("child") is not None}
        self.steps = []
        link = tip
        while link != base:
            joint = by_child[link]
            origin = joint.find("origin")
            read = lambda name: [float(v) for v in (
                origin.get(name, "0 0 0") if origin is not None else "0 0 0").split()]
            fixed = np.eye(4)
            fixed[:3, :3] = rotation_of_rpy(*read("rpy"))
            fixed[:3, 3] = read("xyz")
            self.steps.insert(0, (joint, fixed))
            link = joint.find("parent").get("link")
        moving = [joint for joint, _ in self.steps if joint.get("type") != "fixed"]
        limit = lambda name: np.array([float(j.find("limit").get(name)) for j in moving])
        self.names = [joint.get("name") for joint in moving]
        self.lower, self.upper, self.velocity = limit("lower"), limit("upper"), limit("velocity")

    def forward(self, positions):
        """The tip in the base frame, a 4 x 4 matrix."""
        values = dict(zip(self.names, positions))
        pose = np.eye(4)
        for joint, fixed in self.steps:
            pose = pose @ fixed
            if joint.get("type") != "fixed":
                turn = np.eye(4)
                axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
                turn[:3, :3] = rotation_about(axis, values[joint.get("name")])
                pose = pose @ turn
        return pose


def seconds(duration):
    return duration.sec + duration.nanosec * 1e-9


class Motion:
    """A joint trajectory message in numbers."""

    def __init__(self, message):
        self.names = list(message.joint_names)
        self.times = np.array([seconds(p.time_from_start) for p in message.points])
        self.positions = np.array([p.positions for p in message.points])
        self.velocities = np.array([p.velocities for p in message.points])

    def tips(self, arm, per_step=8):
        """Times and poses of the tip, between the points as well."""
        order = [self.names.index(name) for name in arm.names]
        fine = np.interp(
            np.linspace(0, len(self.times) - 1, (len(self.times) - 1) * per_step + 1),
            np.arange(len(self.times)), self.times)
        columns = [np.interp(fine, self.times, self.positions[:, i]) for i in order]
        return fine, np.array([arm.forward(q) for q in np.transpose(columns)])

    def assert_executable(self, arm):
        """What joint_trajectory_controller checks, and what it does not."""
        assert self.names == arm.names
        assert self.times[0] > 0 and np.all(np.diff(self.times) > 0)
        assert np.all(np.isfinite(self.positions)) and np.all(np.isfinite(self.velocities))
        assert np.all(self.velocities[-1] == 0)
        assert np.all(self.positions >= arm.lower) and np.all(self.positions <= arm.upper)
        slack = 1 + 1e-6
        assert np.all(np.abs(self.velocities) <= arm.velocity * slack)
        steps = np.abs(np.diff(self.positions, axis=0)) / np.diff(self.times)[:, None]
        assert np.all(steps <= arm.velocity * slack), (steps / arm.velocity).max()

    def pour_location(self, arm):
        """The time-weighted mean (x, y) of the tip while the cup is tilted beyond 70 degrees."""
        times, tips = self.tips(arm)
        # The cup stands upright where the motion begins: at the grasp.
        cup_axis = tips[0][:3, :3].T @ np.array([0.0, 0.0, 1.0])
        upright = np.clip([(tip[:3, :3] @ cup_axis)[2] for tip in tips], -1, 1)
        pouring = np.degrees(np.arccos(upright)) > POURING_DEG
        assert pouring.any(), "the motion never pours"
        weights = np.gradient(times)[pouring]
        return np.average(tips[pouring][:, :2, 3], axis=0, weights=weights)

    def source_cup(self, arm):
        """The (x, y) of the tip at the grasp."""
        return self.tips(arm)[1][0][:2, 3]
