"""That verify.py finds what is wrong: a sample of ours passes every check, and each check fails one that was
spoiled in one place.

    .venv-verify/bin/python -m pytest tests/verify

The sample comes from $TCVAE_BIN_DIR/tcvae (cargo's target/debug by default).
"""

import copy
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import orjson
import pinocchio
import pytest

import verify

ROOT = Path(__file__).resolve().parents[2]
BINARIES = Path(os.environ.get("TCVAE_BIN_DIR", ROOT / "target" / "debug"))
TASK = {"pour_location": [0.65, 0.35], "source_cup": [0.60, 0.10]}


# --- What is verified ------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def samples():
    program = BINARIES / "tcvae"
    assert program.is_file(), f"{program} is not built; ./x test builds it, or set TCVAE_BIN_DIR"
    locations = [f"--task={name}={x},{y}" for name, (x, y) in TASK.items()]
    model = ROOT / "models" / "pouring.safetensors"
    command = [program, "sample", model, *locations, "--count", "12", "--random-manner", "--json"]
    return json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["samples"]


class Setup:
    """A robot, a task and an entry, all of which a test may spoil."""

    def __init__(self, folder, entry):
        self.folder, self.entry = folder, copy.deepcopy(entry)
        self.urdf = ElementTree.parse(ROOT / "config" / "baxter.urdf")
        for link in self.urdf.iter("link"):
            for shape in link.findall("collision"):
                link.remove(shape)
        # A ball on the base and one in the hand, far from each other and from the table.
        self.ball("torso", 0.05)
        self.ball("left_hand", 0.02)
        self.collision = {"table_height_m": -0.5}
        self.limits, self.validity, self.action = {}, {}, {}

    def ball(self, link, radius, xyz=(0, 0, 0)):
        place = next(element for element in self.urdf.iter("link") if element.get("name") == link)
        shape = ElementTree.SubElement(place, "collision")
        ElementTree.SubElement(shape, "origin", xyz=" ".join(map(str, xyz)))
        geometry = ElementTree.SubElement(shape, "geometry")
        ElementTree.SubElement(geometry, "sphere", radius=str(radius))

    @property
    def sample(self):
        return self.entry["sample"]

    @property
    def points(self):
        return self.sample["joint_trajectory"]["points"]

    @property
    def poses(self):
        return self.sample["end_effector_trajectory"]["points"]

    def array(self, key):
        return np.array([point[key] for point in self.points])

    def set_times(self, times):
        for point, pose, time in zip(self.points, self.poses, times):
            point["time_from_start"] = pose["time_from_start"] = float(time)

    def robot(self):
        urdf = self.folder / "robot.urdf"
        self.urdf.write(urdf)
        text = (ROOT / "config" / "robots" / "baxter.toml").read_text()
        text = re.sub(r"^# urdf = .*$", f'urdf = "{urdf}"', text, flags=re.MULTILINE)
        text = re.sub(r"^\[collision\]$(.*?)^(?=\[)", "", text, flags=re.MULTILINE | re.DOTALL)
        text += f"\n[collision]\n{toml(self.collision)}"
        for joint, limits in self.limits.items():
            text += f"\n[limits.{joint}]\n{toml(limits)}"
        path = self.folder / "robot.toml"
        path.write_text(text)
        return verify.Robot(path)

    def task(self):
        base = ROOT / "config" / "tasks" / "pour.toml"
        text = f'based_on = "{base}"\n[validity]\n{toml(self.validity)}[action]\n{toml(self.action)}'
        path = self.folder / "task.toml"
        path.write_text(text)
        return verify.Task(path)

    def pour(self):
        """The pour as it is measured, and each quantity that may be bounded."""
        rotations, positions = self.robot().tip_poses(self.array("positions"))
        pour = verify.Pour(self.task(), rotations, positions)
        times = self.array("time_from_start")
        return pour, pour.measures(rotations, (times[1] - times[0]) / self.sample["slowdown"])

    def findings(self):
        return verify.verify(self.robot(), self.task(), orjson.dumps(self.entry)).of

    def violated(self):
        return {name for name, finding in self.findings().items() if finding[1]}


def toml(values):
    def written(value):
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{name} = {written(v)}" for name, v in value.items()) + " }"
        if isinstance(value, list):
            return "[" + ", ".join(map(written, value)) + "]"
        return json.dumps(value)

    return "".join(f"{name} = {written(value)}\n" for name, value in values.items())


@pytest.fixture
def setup(samples, tmp_path):
    request = {
        "task": TASK, "tolerance_m": 0.02, "velocity_scale": 1.0, "acceleration_scale": 1.0, "start": None,
    }
    setup = Setup(tmp_path, {"request": request, "sample": dict(samples[0], min_clearance=None)})
    # As cubics, and so slow that they are well inside all limits.
    for point in setup.points:
        point.pop("accelerations", None)
    slow_down(setup, 2)
    return setup


def slow_down(setup, by):
    setup.set_times(by * setup.array("time_from_start"))
    setup.sample["slowdown"] *= by
    for point in setup.points:
        point["velocities"] = [velocity / by for velocity in point["velocities"]]


def with_accelerations(setup):
    accelerations = np.gradient(setup.array("velocities"), setup.array("time_from_start"), axis=0)
    accelerations[[0, -1]] = 0
    for point, acceleration in zip(setup.points, accelerations):
        point["accelerations"] = acceleration.tolist()


def with_approach(setup):
    """An approach from 0.2 rad away, along one minimum-jerk profile of 3 s."""
    robot, count, secs = setup.robot(), 30, 3.0
    first = setup.array("positions")[0]
    start = first + 0.2 * np.sign(0.5 * (robot.lower + robot.upper) - first)
    shares = np.arange(1, count) / count
    profile = shares**3 * (10 - 15 * shares + 6 * shares**2)
    speed = 30 * shares**2 * (1 - shares) ** 2 / secs
    positions = start + profile[:, None] * (first - start)
    rotations, places = robot.tip_poses(positions)
    later = setup.array("time_from_start")
    times = np.concatenate([shares * secs, later - later[0] + secs])
    for i in reversed(range(count - 1)):
        x, y, z, w = pinocchio.Quaternion(rotations[i]).coeffs().tolist()
        transform = {
            "translation": dict(zip("xyz", map(float, places[i]))),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        }
        point = {"positions": positions[i].tolist(), "velocities": (speed[i] * (first - start)).tolist()}
        setup.points.insert(0, point)
        setup.poses.insert(0, {"transforms": [transform]})
    setup.set_times(times)
    setup.sample["primitive_start_index"] = count - 1
    setup.entry["request"]["start"] = dict(zip(robot.names, start.tolist())) | {"head_pan": 0.0}


# --- Samples that are as they should be ------------------------------------------------------------------


def test_our_samples_pass_every_check(setup, samples):
    robot = verify.Robot(ROOT / "config" / "robots" / "baxter.toml")
    assert len(samples) == 12
    for sample in samples:
        setup.entry["sample"] = sample
        findings = verify.verify(robot, setup.task(), orjson.dumps(setup.entry)).of
        assert [(name, finding) for name, finding in findings.items() if finding[1]] == []
        assert len(findings) > 25


def test_a_slow_sample_passes_with_the_shapes_of_these_tests(setup):
    assert setup.violated() == set()


def test_a_sample_with_an_approach_passes(setup):
    with_approach(setup)
    assert setup.violated() == set()


def test_a_sample_with_accelerations_passes(setup):
    with_accelerations(setup)
    setup.limits = {"left_s0": {"velocity": 1.5, "acceleration": 100.0, "jerk": 1e6}}
    findings = setup.findings()
    assert {name for name, finding in findings.items() if finding[1]} == set()
    assert {"positions_quintic", "accelerations", "jerks"} <= set(findings)


def test_a_quaternion_of_the_other_sign_and_another_order_of_joints_are_the_same_motion(setup):
    for pose in setup.poses[::2]:
        rotation = pose["transforms"][0]["rotation"]
        rotation.update({name: -value for name, value in rotation.items()})
    setup.sample["joint_trajectory"]["joint_names"].reverse()
    for point in setup.points:
        point["positions"].reverse()
        point["velocities"].reverse()
    assert setup.violated() == set()


# --- Samples that are spoiled in one place ---------------------------------------------------------------


def lacking_velocities(setup):
    del setup.points[7]["velocities"]


def lacking_a_pose(setup):
    setup.poses.pop()


def starting_after_the_end(setup):
    setup.sample["primitive_start_index"] = len(setup.points)


def faster_than_learned(setup):
    setup.sample["slowdown"] = 0.9


def without_a_number(setup):
    setup.points[5]["positions"][2] = None


def of_another_arm(setup):
    setup.sample["joint_trajectory"]["joint_names"][3] = "right_e1"


def without_one_joint(setup):
    setup.sample["joint_trajectory"]["joint_names"].pop()


def two_points_at_one_time(setup):
    setup.points[4]["time_from_start"] = setup.points[3]["time_from_start"]


def from_time_zero(setup):
    times = setup.array("time_from_start")
    setup.set_times(times - times[0])


def poses_at_other_times(setup):
    setup.poses[20]["time_from_start"] += 1e-6


def one_longer_step(setup):
    times = setup.array("time_from_start")
    times[40:] += 1e-5 * times[0]
    setup.set_times(times)


def in_motion_at_the_end(setup):
    setup.points[-1]["velocities"][6] = 1e-6


def beyond_a_limit(setup):
    setup.points[30]["positions"][1] = 1.0471


def nearest_to_a_limit(setup):
    """The inner point and joint that come nearest to a limit: (point, joint, signed distance)."""
    robot, positions = setup.robot(), setup.array("positions")[1:-1]
    below, over = positions - robot.lower, robot.upper - positions
    i, j = np.unravel_index(np.minimum(below, over).argmin(), positions.shape)
    towards = over[i, j] if over[i, j] < below[i, j] else -below[i, j]
    return i + 1, j, towards


def swinging_beyond_a_limit(setup):
    i, j, towards = nearest_to_a_limit(setup)
    setup.points[i]["velocities"][j] = float(20 * towards / setup.array("time_from_start")[0])


def swinging_beyond_a_limit_by_acceleration(setup):
    with_accelerations(setup)
    i, j, towards = nearest_to_a_limit(setup)
    setup.points[i]["accelerations"][j] = float(200 * towards / setup.array("time_from_start")[0] ** 2)


def asked_for_less_speed(setup):
    setup.entry["request"]["velocity_scale"] = 0.1


def played_faster(setup):
    setup.set_times(0.2 * setup.array("time_from_start"))


def with_a_slower_joint(setup):
    setup.limits = {"left_e1": {"velocity": 0.05}}


def with_an_acceleration_limit(setup):
    setup.limits = {"left_w2": {"acceleration": 1e-3}}


def asked_for_less_acceleration(setup):
    setup.limits = {"left_w2": {"acceleration": 100.0}}
    setup.entry["request"]["acceleration_scale"] = 1e-4


def with_a_jerk_limit(setup):
    setup.limits = {"left_w2": {"jerk": 1e-3}}


def with_a_jump(setup):
    for point in setup.points[50:]:
        point["positions"][6] += 0.8


def with_a_tip_elsewhere(setup):
    setup.poses[60]["transforms"][0]["translation"]["z"] += 2e-6


def with_a_tip_turned(setup):
    rotation = setup.poses[60]["transforms"][0]["rotation"]
    turned = pinocchio.Quaternion(*(rotation[name] for name in "wxyz"))
    turned = turned * pinocchio.Quaternion(1.0, 2e-6, 0.0, 0.0)
    rotation.update(dict(zip("xyzw", map(float, turned.coeffs()))))


def with_a_longer_quaternion(setup):
    rotation = setup.poses[60]["transforms"][0]["rotation"]
    rotation.update({name: 1.00001 * value for name, value in rotation.items()})


def asked_for_another_place(setup):
    setup.entry["request"]["task"] = {"pour_location": [0.65, 0.35], "source_cup": [0.60, 0.125]}


def without_a_pour(setup):
    setup.action = {"above_deg": 160.0}


def with_two_pours(setup):
    last = setup.array("time_from_start")[-1]
    for points in (setup.points, setup.poses):
        points.extend(copy.deepcopy(points))
    times = setup.array("time_from_start")
    times[len(times) // 2 :] += last
    setup.set_times(times)


def reporting(key, by):
    def spoil(setup):
        setup.sample[key] += by

    return spoil


def reporting_another_place(setup):
    setup.sample["empirical_task"][0]["point"]["y"] += 2e-6


def reporting_a_clearance_of_nothing(setup):
    setup.sample["min_clearance"] = 0.123


def with_a_thick_body(setup):
    setup.ball("torso", 0.6)


def with_a_long_tool(setup):
    setup.collision["parts"] = [
        {"link": "left_gripper", "from_m": [0.0, 0.0, 0.0], "to_m": [0.0, 0.0, -1.0], "radius_m": 0.8}
    ]


def above_a_high_table(setup):
    setup.collision["table_height_m"] = 0.1


def through_a_small_ball(setup):
    """A ball beside the way of the hand, which it touches between two points and at none of them."""
    robot = setup.robot()
    times, positions, velocities = map(setup.array, ("time_from_start", "positions", "velocities"))
    middle = verify.Spline(times, positions, velocities).at(verify.BETWEEN[1:2])[:, :, 0]
    hand = next(shape for shape in robot.shapes if shape[0] == "left_hand")
    places = [
        frames[hand[1]][0] @ hand[2][0] + frames[hand[1]][1]
        for frames in (robot.placements(positions)[0], robot.placements(middle)[0])
    ]
    gaps = np.linalg.norm(places[1][:, None] - places[0], axis=2).min(axis=1)
    i = int(gaps.argmax())
    # The hand's ball has a radius of 2 cm; the new one reaches as far as the nearest point but 1 mm.
    assert gaps[i] > 2e-3
    setup.collision["clearance_m"] = 0.0
    for shape in next(link for link in setup.urdf.iter("link") if link.get("name") == "left_hand"):
        shape.find("geometry/sphere").set("radius", "0.001")
    setup.ball("torso", gaps[i] - 0.0015, places[1][i])


SPOILED = [
    ("shape", lacking_velocities),
    ("shape", lacking_a_pose),
    ("shape", starting_after_the_end),
    ("shape", faster_than_learned),
    ("finite", without_a_number),
    ("joint_names", of_another_arm),
    ("joint_names", without_one_joint),
    ("times", two_points_at_one_time),
    ("times", from_time_zero),
    ("times", poses_at_other_times),
    ("equal_steps", one_longer_step),
    ("last_velocity", in_motion_at_the_end),
    ("positions", beyond_a_limit),
    ("positions_cubic", swinging_beyond_a_limit),
    ("positions_quintic", swinging_beyond_a_limit_by_acceleration),
    ("velocities", asked_for_less_speed),
    ("velocities", played_faster),
    ("velocities", with_a_slower_joint),
    ("accelerations", with_an_acceleration_limit),
    ("accelerations", asked_for_less_acceleration),
    ("jerks", with_a_jerk_limit),
    ("steps", with_a_jump),
    ("steps", with_a_slower_joint),
    ("tip_position", with_a_tip_elsewhere),
    ("tip_orientation", with_a_tip_turned),
    ("tip_orientation", with_a_longer_quaternion),
    ("task", asked_for_another_place),
    ("task", without_a_pour),
    ("validity.actions", with_two_pours),
    ("reported.task_error", reporting("task_error", 2e-6)),
    ("reported.joint_margin", reporting("joint_margin", -2e-6)),
    ("reported.empirical_task", reporting_another_place),
    ("reported.min_clearance", reporting_a_clearance_of_nothing),
    ("self_clearance", with_a_thick_body),
    ("self_between", with_a_thick_body),
    ("self_clearance", with_a_long_tool),
    ("table_clearance", above_a_high_table),
    ("table_between", above_a_high_table),
]
# Checks that tell one thing alone: nothing else may complain.
ALONE = {
    "shape", "finite", "joint_names", "equal_steps", "accelerations", "jerks", "tip_position",
    "tip_orientation", "reported.joint_margin", "reported.task_error", "reported.empirical_task",
    "reported.min_clearance",
}


@pytest.mark.parametrize(("check", "spoil"), SPOILED, ids=lambda value: getattr(value, "__name__", value))
def test_a_spoiled_sample_fails(setup, check, spoil):
    spoil(setup)
    violated = setup.violated()
    assert check in violated
    if check in ALONE:
        assert violated == {check}


def test_a_small_ball_is_met_between_two_points_only(setup):
    through_a_small_ball(setup)
    assert setup.violated() == {"self_between"}


def test_every_check_can_fail(setup):
    """All the names that a full sample is told by are among those that a test sees fail."""
    with_accelerations(setup)
    setup.limits = {"left_s0": {"acceleration": 100.0, "jerk": 1e6}}
    setup.sample["min_clearance"] = 0.0
    told = {name for name in setup.findings() if not name.startswith("validity.")}
    assert told <= {check for check, _ in SPOILED}
    # And all that verify.py says it does.
    listed = set(re.findall(r"^    (\w[\w, .*]*?)  +", verify.__doc__, flags=re.MULTILINE))
    listed = {name for names in listed for name in names.split(", ") if not name.endswith("*")}
    assert listed == {name for name in told if not name.startswith("reported.")}


@pytest.mark.parametrize(
    ("bound", "side"),
    [(bound, side) for bound in verify.INTERVALS for side in ("lower", "upper")]
    + [(bound, "upper") for bound in verify.MAXIMA],
)
def test_each_bound_of_validity_can_be_broken_and_its_neighbour_not(setup, bound, side):
    _, measures = setup.pour()
    low, high = measures[bound]
    if bound in verify.MAXIMA:
        loose, tight = high + 1e-3, high - 1e-3
    else:
        loose = {"lower": low - 1e-3, "upper": high + 1e-3}
        tight = loose | ({"lower": low + 1e-3} if side == "lower" else {"upper": high - 1e-3})
        tight = {name: max(value, loose["lower"]) for name, value in tight.items()}
    setup.validity = {bound: loose}
    assert setup.violated() == set()
    setup.validity = {bound: tight}
    assert setup.violated() == {f"validity.{bound}"}


def test_validity_is_measured_as_learned_however_slow_the_motion_is_played(setup):
    duration = setup.pour()[1]["duration_secs"][0]
    slow_down(setup, 3)
    assert setup.pour()[1]["duration_secs"][0] == pytest.approx(duration)
    assert setup.violated() == set()


def test_a_motion_that_is_faster_than_learned_keeps_bounds_of_speeds_and_needs_no_others(setup):
    slow_down(setup, 0.5)
    setup.sample["slowdown"] = 1.0
    setup.entry["request"]["speed"] = 1.2
    executed = setup.pour()[1]["max_speed_m_per_s"][1]
    setup.validity = {"max_speed_m_per_s": 1.01 * executed}
    assert setup.violated() == set()
    # As learned it was 1.2 times slower, and would pass.
    setup.validity = {"max_speed_m_per_s": 0.99 * executed}
    assert setup.violated() == {"validity.max_speed_m_per_s"}


def test_an_approach_from_elsewhere_than_the_start_is_seen(setup):
    with_approach(setup)
    setup.entry["request"]["start"]["left_s1"] -= 0.3
    assert {"velocities", "steps"} <= setup.violated()


def test_a_clearance_that_is_right_passes_and_one_that_is_not_does_not(setup):
    robot = setup.robot()
    apart, above = robot.clearances(robot.placements(setup.array("positions"))[0])
    least = float(min(apart.min(), above.min()))
    setup.sample["min_clearance"] = least
    assert setup.violated() == set()
    setup.sample["min_clearance"] = least + 2e-6
    assert setup.violated() == {"reported.min_clearance"}


def test_pairs_that_are_ignored_are_not_held_apart(setup):
    setup.ball("torso", 0.6)
    assert "self_clearance" in setup.violated()
    setup.collision["ignore"] = [["left_hand", "torso"]]
    assert "self_clearance" not in setup.findings()


def test_shapes_that_overlap_wherever_the_joints_stand_are_left_out_and_told(setup):
    setup.ball("torso", 3.0)
    robot = setup.robot()
    assert robot.left_out == [("torso", "left_hand", 1.0)]


# --- What the checks stand on ----------------------------------------------------------------------------


def test_distances_of_segments_are_those_of_the_nearest_of_many_points():
    rng = np.random.default_rng(1)
    a, u, b, v = rng.uniform(-1, 1, (4, 3, 300))
    v[:, :40] = -0.7 * u[:, :40]  # parallel
    u[:, 40:60] = 0
    v[:, 50:80] = 0
    distances = verify.segment_distances(a, u, b, v)
    shares = np.linspace(0, 1, 101)
    first = a[..., None] + u[..., None] * shares
    second = b[..., None] + v[..., None] * shares
    sampled = np.linalg.norm(first[..., :, None] - second[..., None, :], axis=0).min(axis=(1, 2))
    assert (distances <= sampled + 1e-9).all()
    # Half a step of segments up to 3.5 m long, on either.
    assert (sampled - distances).max() < 0.035


def test_shapes_become_capsules():
    def capsule(text):
        half, radius = verify.capsule_of(ElementTree.fromstring(f"<geometry>{text}</geometry>"))
        return half.tolist(), radius

    assert capsule('<sphere radius="0.2"/>') == ([0, 0, 0], 0.2)
    assert capsule('<cylinder radius="0.1" length="0.6"/>') == ([0, 0, 0.3], 0.1)
    assert capsule('<box size="0.6 2 0.8"/>') == ([0, 1, 0], pytest.approx(0.5))
    assert capsule('<box size="1 1 0.5"/>')[0] == [0.5, 0, 0]
    mesh = ElementTree.fromstring('<geometry><mesh filename="a.stl"/></geometry>')
    assert verify.capsule_of(mesh) is None


@pytest.mark.parametrize(
    ("urdf", "base", "tip"),
    [
        ("config/baxter.urdf", "base", "left_gripper"),
        ("config/baxter.urdf", "left_upper_shoulder", "left_gripper"),
        ("config/panda.urdf", "panda_link0", "panda_hand_tcp"),
        ("tests/fixtures/odd_arm.urdf", "world", "tool"),
        ("tests/fixtures/odd_arm.urdf", "plate", "fore"),
    ],
)
def test_links_are_where_pinocchio_has_them(tmp_path, urdf, base, tip):
    path = tmp_path / "robot.toml"
    robot = {"urdf": str(ROOT / urdf), "base_frame": base, "tip_link": tip}
    try:
        path.write_text(toml(robot) + "[arm]\njoints = []\n")
        verify.Robot(path)
    except verify.UsageError as error:
        names = re.search(r"moves (\[.*?\])", str(error)).group(1).replace("'", '"')
    path.write_text(toml(robot) + f"[arm]\njoints = {names}\n")
    robot = verify.Robot(path)
    q = np.random.default_rng(1).uniform(-3, 3, (50, len(robot.names)))
    _, tip = robot.placements(q)
    for ours, theirs in zip(tip, robot.tip_poses(q)):
        assert np.abs(ours - theirs).max() < 1e-9


def test_splines_meet_their_points_and_derivatives():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.1, 1, 6))
    positions, velocities, accelerations = rng.uniform(-1, 1, (3, 6, 2))
    for given in (None, accelerations):
        spline = verify.Spline(times, positions, velocities, given)
        at_ends = [spline.at(np.array([0.0, 1.0]), order) for order in range(3)]
        expected = [positions, velocities, accelerations][: 2 if given is None else 3]
        for values, ends in zip(expected, at_ends):
            assert np.abs(ends[:, :, 0] - values[:-1]).max() < 1e-9
            assert np.abs(ends[:, :, 1] - values[1:]).max() < 1e-9


def test_the_largest_speed_of_a_step_is_found_between_its_samples():
    # From rest to rest in a step of 1 s a cubic's top speed is 1.5 times its mean, amid the step.
    spline = verify.Spline(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), np.zeros((2, 1)))
    values, _, times = spline.largest(1, np.abs)
    assert values[0] == pytest.approx(1.5, rel=1e-9) and times[0] == pytest.approx(0.5)


def test_a_pour_is_measured_at_its_crossings(tmp_path):
    # The tilt rises to 80 degrees from step 20 to 40 and falls from 60 to 80: above 70 from 37.5 to 62.5.
    steps = np.arange(100)
    tilts = np.radians(80 * np.clip(np.minimum((steps - 20) / 20, (80 - steps) / 20), 0, 1))
    upright = verify.rotation_of_rpy(0.3, -1.2, 0.8)
    rotations = np.array([verify.rotation_of_rpy(tilt, 0, 0) @ upright for tilt in tilts])
    positions = np.stack([0.6 + 0 * steps, 0.001 * steps, 0.15 * np.clip(steps / 20, 0, 1)], axis=1)
    task = verify.Task(ROOT / "config" / "tasks" / "pour.toml")
    pour = verify.Pour(task, rotations, positions)
    assert pour.locations(task)["pour_location"] == pytest.approx([0.6, 0.05])
    assert pour.locations(task)["source_cup"] == pytest.approx([0.6, 0.0])
    measures = {name: low for name, (low, _) in pour.measures(rotations, 0.1).items()}
    expected = {
        "action_start_secs": 3.75, "action_duration_secs": 2.5, "duration_secs": 9.9, "max_tilt_deg": 80.0,
        "max_end_tilt_deg": 0.0, "lift_m": 0.15, "max_sink_m": 0.0, "end_height_m": 0.15,
        "arrival_height_m": 0.0, "max_turn_deg_per_s": 40.0,
    }
    assert {name: measures[name] for name in expected} == pytest.approx(expected, abs=1e-5)


def test_tilts_that_waver_are_one_pour_until_they_fall_far_enough():
    def count(dip):
        tilts = [0, 80, dip, 80, 0]
        rotations = np.array([verify.rotation_of_rpy(np.radians(tilt), 0, 0) for tilt in tilts])
        task = verify.Task(ROOT / "config" / "tasks" / "pour.toml")
        return verify.Pour(task, rotations, np.zeros((5, 3))).count

    assert (count(60), count(45)) == (1, 2)


# --- The program -----------------------------------------------------------------------------------------


def run(setup, lines, *arguments):
    setup.robot(), setup.task()
    path = setup.folder / "samples.jsonl"
    path.write_bytes(b"".join(orjson.dumps(line) + b"\n" for line in lines))
    files = [path, "--robot", setup.folder / "robot.toml", "--task", setup.folder / "task.toml"]
    command = [sys.executable, Path(verify.__file__), *files, *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_program_ends_with_0_for_good_samples_and_1_for_bad_ones_and_says_which(setup, monkeypatch):
    good = setup.entry
    bad = copy.deepcopy(good)
    bad["sample"]["joint_margin"] += 0.5
    assert run(setup, [good] * 300).returncode == 0
    # More than one block of lines, so that the numbers of lines must be carried on.
    ended = run(setup, [good] * 300 + [bad], "--json")
    assert ended.returncode == 1, ended.stderr
    answer = json.loads(ended.stdout)
    assert (answer["samples"], answer["violated_samples"]) == (301, 1)
    [violation] = answer["violations"]
    assert (violation["check"], violation["line"]) == ("reported.joint_margin", 301)
    checked = {check["name"]: check["checked"] for check in answer["checks"]}
    assert checked["velocities"] == 301
    assert "line 2: reported.joint_margin: " in run(setup, [good, bad]).stdout


def test_the_program_ends_with_2_where_it_can_not_verify(setup):
    assert run(setup, []).returncode == 2
    setup.collision["color"] = 3
    with pytest.raises(verify.UsageError, match="color"):
        setup.robot()
    (setup.folder / "task.toml").write_text('task = "arcs"\n')
    with pytest.raises(verify.UsageError, match="tilt"):
        verify.Task(setup.folder / "task.toml")


def test_a_line_that_is_no_json_is_a_violation(setup):
    findings = verify.verify(setup.robot(), setup.task(), b"{\n")
    assert findings.of["shape"][1]
