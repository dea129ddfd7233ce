"""Bad input of every kind: what can't be served is refused with a code and a reason, and the node
goes on serving."""

import json
import math
import random
import re
import shutil
import struct

import pytest
from conftest import ROOT, start_node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tcvae_msgs.msg import ErrorCode
from tcvae_msgs.srv import DescribePrimitive, LoadModel, SampleTrajectory, SetManner
from user import User, location, pose, task

POUR, SOURCE = (0.65, 0.37), (0.60, 0.10)
MODEL = ROOT / "models" / "pouring.safetensors"
NAN, INF = math.nan, math.inf
# Of the left arm's limits.
MIDDLE = [0.0, -0.55, 0.0, 1.284, 0.0, 0.2616, 0.0]


def sample(user, **fields):
    return user.call(SampleTrajectory, "sample_trajectory", **fields)


def assert_still_serves(user):
    response = sample(user, task=task(POUR, SOURCE))
    assert response.error_code == ErrorCode.OK, response.error_message


# ---- Goals on topics: nothing is published, and /rosout says why ----

BAD_GOALS = {
    "nan": (pose(NAN, 0.3), ["NOT_FINITE (10)", "pour_location"]),
    "infinity": (pose(0.65, -INF), ["NOT_FINITE (10)", "-inf"]),
    "no frame": (pose(*POUR, frame=""), ["FRAME_UNKNOWN (11)", "empty", '"base"']),
    "unknown frame": (pose(*POUR, frame="moon"), ["FRAME_UNKNOWN (11)", '"moon"', '"base"']),
    "outside the trained region": (pose(5.0, 0.3), ["OUT_OF_DISTRIBUTION (20)", "5.000", "trained"]),
}


@pytest.mark.parametrize("name", BAD_GOALS)
def test_a_bad_goal_publishes_nothing_and_says_why(node, user, name):
    user.publish_location("source_cup", *SOURCE)
    goal, words = BAD_GOALS[name]
    user.goal_pose.publish(goal)
    for word in words:
        user.hears(word)
    assert user.trajectory(timeout=0.5) is None
    assert any(all(word in line for word in words) for line in node.lines)
    # A bad goal does not stay in the way of a good one.
    assert user.ask(*POUR)


def printed_place(text, topic):
    """The x and y of a printed `ros2 topic pub` line."""
    line = next(line for line in text.splitlines() if f"/tcvae/{topic} " in line)
    return [float(line.split(f"{axis}: ")[-1].split("}")[0].split(",")[0]) for axis in "xy"]


def test_a_goal_before_any_source_cup_tells_which_line_is_missing(node, user):
    goal = printed_place(node.output, "goal_pose")
    user.goal_pose.publish(pose(*goal))
    user.hears("NO_TASK (1)")
    assert user.trajectory(timeout=0.5) is None
    (message,) = [m.msg for m in user.log if "NO_TASK" in m.msg]
    assert "ros2 topic pub --once /tcvae/source_cup geometry_msgs/msg/PointStamped" in message
    # What it says to publish is served, together with the goal that the node printed at start.
    user.publish_location("source_cup", *printed_place(message, "source_cup"))
    assert user.ask(*goal)


@pytest.mark.parametrize(("point", "word"), [
    ((NAN, 0.1, "base"), "NOT_FINITE (10)"),
    ((0.6, 0.1, ""), "FRAME_UNKNOWN (11)"),
    ((0.6, 0.1, "table"), "FRAME_UNKNOWN (11)"),
])
def test_a_bad_task_location_is_refused_and_the_old_one_stays(node, user, point, word):
    user.publish_location("source_cup", *SOURCE)
    x, y, frame = point
    user.publish_location("source_cup", x, y, frame)
    user.hears(word)
    user.hears("source_cup refused")
    assert user.ask(*POUR)


# ---- Requests: every code that a request can get ----

GOOD = {"task": task(POUR, SOURCE)}
BAD_REQUESTS = {
    "no task": ({}, ErrorCode.NO_TASK, ["pour_location", "ros2 topic pub --once"]),
    "half a task": ({"task": task(POUR, SOURCE)[:1]}, ErrorCode.NO_TASK, ["source_cup"]),
    "unknown location": (
        {"task": task(POUR, SOURCE) + [location("drain", 0, 0)]},
        ErrorCode.TASK_UNKNOWN, ["drain", "pour_location", "source_cup"]),
    "a location twice": ({"task": task(POUR, SOURCE) * 2}, ErrorCode.BAD_REQUEST, ["twice"]),
    "nan": ({"task": task((NAN, 0.3), SOURCE)}, ErrorCode.NOT_FINITE, ["pour_location"]),
    "infinity": ({"task": task(POUR, (INF, 0.1))}, ErrorCode.NOT_FINITE, ["source_cup"]),
    "empty frame": (
        {"task": [location("pour_location", *POUR, frame="")]}, ErrorCode.FRAME_UNKNOWN, ["base"]),
    "unknown frame": (
        {"task": [location("pour_location", *POUR, frame="moon")]},
        ErrorCode.FRAME_UNKNOWN, ["moon", "base"]),
    "outside the trained region": (
        {"task": task((1.2, 0.3), SOURCE)}, ErrorCode.OUT_OF_DISTRIBUTION, ["1.2", "trained"]),
    "out of reach": (
        {"task": task((2.5, 0.3), SOURCE), "allow_out_of_distribution": True},
        ErrorCode.UNREACHABLE, ["point", "reach"]),
    "unknown manner": (
        GOOD | {"manner_names": ["haste"], "manner_values": [1.0]},
        ErrorCode.MANNER_UNKNOWN, ["haste"]),
    "more names than values": (
        GOOD | {"manner_names": ["haste"], "manner_values": []}, ErrorCode.BAD_REQUEST, ["1", "0"]),
    "a million samples": (GOOD | {"count": 1_000_000}, ErrorCode.BAD_REQUEST, ["1000000", "64"]),
    "unknown order": (GOOD | {"rank_by": "beauty"}, ErrorCode.BAD_REQUEST, ["beauty", "margin"]),
    "a scale above 1": (GOOD | {"velocity_scale": 1.5}, ErrorCode.BAD_REQUEST, ["1.5"]),
    "a scale below 0": (GOOD | {"acceleration_scale": -1.0}, ErrorCode.BAD_REQUEST, ["-1"]),
    "a scale of nan": (GOOD | {"velocity_scale": NAN}, ErrorCode.NOT_FINITE, ["velocity_scale"]),
    "a rate below 0": (GOOD | {"rate_hz": -5.0}, ErrorCode.BAD_REQUEST, ["rate_hz"]),
    "a million points": (GOOD | {"rate_hz": 1e6}, ErrorCode.BAD_REQUEST, ["rate_hz"]),
    "a rate of nan": (GOOD | {"rate_hz": NAN}, ErrorCode.NOT_FINITE, ["rate_hz"]),
    "a start of two lengths": (
        GOOD | {"start": JointState(name=["left_s0", "left_s1"], position=[0.0])},
        ErrorCode.BAD_REQUEST, ["2", "1"]),
    "a start without most joints": (
        GOOD | {"start": JointState(name=["left_s0"], position=[0.0])},
        ErrorCode.BAD_REQUEST, ["left_s1"]),
}


@pytest.mark.parametrize("name", BAD_REQUESTS)
def test_a_bad_request_gets_its_code_and_a_reason(node, user, name):
    fields, code, words = BAD_REQUESTS[name]
    response = sample(user, **fields)
    assert (response.error_code, len(response.samples)) == (code, 0), response.error_message
    for word in words:
        assert word in response.error_message
    assert response.model_id
    # The same words are in the log, at once with the code's name.
    user.hears(response.error_message.splitlines()[0])
    assert_still_serves(user)


def test_a_manner_out_of_range_is_refused_by_request_service_and_parameter(node, user):
    axis = user.call(DescribePrimitive, "describe_primitive").manner[0]
    beyond = axis.upper + 0.5
    response = sample(user, **GOOD, manner_names=[axis.name], manner_values=[beyond])
    assert response.error_code == ErrorCode.MANNER_RANGE
    for word in (axis.name, f"{beyond:g}", f"{axis.upper:g}"):
        assert word in response.error_message
    response = user.call(SetManner, "set_manner", names=[axis.name], values=[beyond])
    assert response.error_code == ErrorCode.MANNER_RANGE
    assert response.manner[0].value == 0.0
    assert f"{beyond:g}" in user.try_parameter(f"manner.{axis.name}", beyond)
    assert user.parameter(f"manner.{axis.name}") == 0.0


def test_bad_manners_are_refused_by_the_service_and_change_nothing(node, user):
    manner = user.call(DescribePrimitive, "describe_primitive").manner
    first, second = manner[0].name, manner[1].name
    for names, values, code in [
        (["haste"], [0.5], ErrorCode.MANNER_UNKNOWN),
        ([first, second], [0.5], ErrorCode.BAD_REQUEST),
        ([first, first], [0.5, 0.6], ErrorCode.BAD_REQUEST),
        ([first, second], [0.5, NAN], ErrorCode.NOT_FINITE),
        ([first, "haste"], [0.5, 0.5], ErrorCode.MANNER_UNKNOWN),
    ]:
        response = user.call(SetManner, "set_manner", names=names, values=values)
        assert response.error_code == code, response.error_message
        assert response.error_message
        assert [m.value for m in response.manner] == [0.0] * len(manner)


def test_a_stale_task_is_refused_and_a_fresh_one_served(node, user):
    user.set_parameter("task.max_age_s", 2.0)
    user.publish_location("source_cup", *SOURCE)
    user.publish_location("pour_location", *POUR)
    assert sample(user).error_code == ErrorCode.OK
    user.wait(2.2)
    response = sample(user)
    assert response.error_code == ErrorCode.STALE_TASK
    assert "2.0" in response.error_message
    assert sample(user, task=task(POUR, SOURCE)).error_code == ErrorCode.OK


def test_by_the_policy_refuse_a_start_far_from_the_first_point_is_refused_and_a_near_one_served(node, user):
    first = sample(user, **GOOD).samples[0].joint_trajectory
    names, there = list(first.joint_names), list(first.points[0].positions)
    user.set_parameter("start.policy", "refuse")
    response = sample(user, **GOOD)
    assert response.error_code == ErrorCode.STALE_JOINT_STATE, response.error_message
    # Other joints of the robot may be among them.
    near = JointState(name=names + ["right_s0"], position=there + [0.3])
    response = sample(user, **GOOD, start=near)
    assert response.error_code == ErrorCode.OK, response.error_message
    assert not any("no joint states" in w for w in response.samples[0].warnings)
    far = JointState(name=names, position=[there[0] + 0.5, *there[1:]])
    response = sample(user, **GOOD, start=far)
    assert response.error_code == ErrorCode.START_TOO_FAR, response.error_message
    assert "left_s0" in response.error_message
    not_finite = JointState(name=names, position=[NAN, *there[1:]])
    assert sample(user, **GOOD, start=not_finite).error_code == ErrorCode.NOT_FINITE


def test_an_arm_elsewhere_is_brought_to_the_first_point(node, user):
    response = sample(user, **GOOD)
    assert any("no joint states" in w for w in response.samples[0].warnings)
    first = response.samples[0].joint_trajectory
    names, there = list(first.joint_names), list(first.points[0].positions)
    away = [q + 0.3 * (middle - q) for q, middle in zip(there, MIDDLE)]
    states = user.matched(user.client.node.create_publisher(JointState, "/joint_states", 10))
    # In two messages, as from two drivers, and the gripper's in between.
    messages = [JointState(name=names, position=away[:3]),  # half a message is none
                JointState(name=names, velocity=[0.0] * 7),
                JointState(name=names[:3], position=away[:3]),
                JointState(name=["l_gripper_l_finger_joint"], position=[0.01]),
                JointState(name=names[3:], position=away[3:])]

    for message in messages:
        states.publish(message)
        user.wait(0.1)
    response = sample(user, **GOOD)
    assert response.error_code == ErrorCode.OK, response.error_message
    brought = response.samples[0]
    begin = brought.primitive_start_index
    points = brought.joint_trajectory.points
    assert len(points) == begin + 100 and begin >= 7
    assert all(abs(v) < 1e-12 for v in points[begin].velocities)
    assert all(abs(a - b) < 0.05 for a, b in zip(points[0].positions, away))
    assert len(brought.position_stddev) == len(points)
    assert list(points[begin].accelerations) == [0.0] * 7
    # A second later they are old.
    user.wait(1.2)
    response = sample(user, **GOOD)
    assert response.samples[0].primitive_start_index == 0
    assert any("start.max_age_s" in w for w in response.samples[0].warnings)


def test_a_table_below_the_hand_is_kept_clear_of(node, user):
    free = sample(user, **GOOD).samples[0]
    assert free.min_clearance >= 0.01
    lowest = min(t.transforms[0].translation.z for t in free.end_effector_trajectory.points)
    user.set_parameter("collision.table_height_m", lowest - 0.02)
    response = sample(user, **GOOD)
    assert response.error_code == ErrorCode.COLLISION or response.samples[0].tries > 1
    user.set_parameter("collision.table_height_m", -10.0)
    assert sample(user, **GOOD).samples[0].joint_trajectory == free.joint_trajectory


def test_trigger_before_any_task_says_what_is_missing(node, user):
    response = user.call(Trigger, "sample")
    assert not response.success
    assert "NO_TASK (1)" in response.message and "ros2 topic pub" in response.message
    assert user.trajectory(timeout=0.3) is None


def test_too_many_requests_at_once_are_busy_and_all_are_answered(node, user):
    client = user.client.service(SampleTrajectory, "/tcvae/sample_trajectory")
    # Each takes long, since every draw fails, and has a short answer.
    request = SampleTrajectory.Request(task=task((2.5, 0.3), SOURCE), sample_manner=True,
                                       allow_out_of_distribution=True)
    user.set_parameter("sample.max_tries", 40)
    # 16 wait, and one is worked on, unless all have come before it was begun; rclpy keeps no more than 10 answers that it has not looked at.
    futures = [client.call_async(request) for _ in range(25)]
    # Meanwhile parameters answer.
    assert user.parameter("task.tolerance_m") == 0.02
    assert not all(future.done() for future in futures)
    assert user.until(lambda: all(future.done() for future in futures), 60.0)
    codes = [future.result().error_code for future in futures]
    assert set(codes) == {ErrorCode.UNREACHABLE, ErrorCode.BUSY}
    assert codes.count(ErrorCode.BUSY) <= 9
    refused = next(f.result() for f in futures if f.result().error_code == ErrorCode.BUSY)
    assert "16" in refused.error_message
    failed = next(f.result() for f in futures if f.result().error_code == ErrorCode.UNREACHABLE)
    assert "40" in failed.error_message and "sample.max_tries" in failed.error_message
    assert_still_serves(user)


# ---- Motions that fail a check ----

def refusals_of_random_requests(user, requests):
    """The messages by code that pours here and there, in manners up to the bounds, are refused
    with."""
    names = [m.name for m in user.call(DescribePrimitive, "describe_primitive").manner]
    draw = random.Random(1)
    place = lambda: (draw.uniform(0.3, 1.0), draw.uniform(-0.3, 0.8))
    messages = {}
    for _ in range(requests):
        manner = [draw.uniform(-3, 3) for _ in names]
        response = sample(user, task=task(place(), place()), allow_out_of_distribution=True,
                          manner_names=names, manner_values=manner)
        messages.setdefault(response.error_code, response.error_message)
        assert (response.error_code == 0) == (len(response.samples) == 1)
    return messages


def test_motions_that_fail_a_check_say_by_how_much(node, user):
    found = refusals_of_random_requests(user, 400)
    for code, form in {
        ErrorCode.UNREACHABLE: r"point \d+ of 100 .* is [\d.]+ cm out of reach .*; move ",
        ErrorCode.JOINT_LIMIT: r"at point \d+ .* left_\w\d would be [\d.]+ rad beyond its limit of",
        ErrorCode.TASK_CHECK_FAILED: r"(the tilt reaches \d+ of the 70 degrees|misses its task: .* m)",
        ErrorCode.INVALID_MOTION: r"[\d.]+ \S+, limit [\d.]+",
    }.items():
        assert re.search(form, found[code]), found
    assert found[ErrorCode.OK] == ""


@pytest.mark.parametrize(("velocity", "code", "form"), [
    (0.5, ErrorCode.TOO_FAST, r"[\d.]+ times slower .*, limit \d"),
    (0.01, ErrorCode.JOINT_JUMP, r"before point \d+ .* left_\w\d would have to jump by [\d.]+ rad"),
])
def test_an_arm_that_is_too_slow_for_the_motion(start, make_client, tmp_path, velocity, code, form):
    description = (ROOT / "config" / "baxter.urdf").read_text()
    urdf = tmp_path / "slow.urdf"
    urdf.write_text(re.sub(r'velocity="[^"]*"', f'velocity="{velocity}"', description))
    start_node(start, "--urdf", str(urdf))
    found = refusals_of_random_requests(User(make_client("user")), 150)
    assert re.search(form, found[code]), found


# ---- Model files ----

def load(user, path):
    return user.call(LoadModel, "load_model", path=str(path))


def edited(path, change):
    """A copy of a model file whose metadata was changed, as a text editor would."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8:8 + length])
    metadata = json.loads(header["__metadata__"]["tcvae"])
    change(metadata)
    header["__metadata__"]["tcvae"] = json.dumps(metadata)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content[8 + length:]


BAD_MODELS = {
    "missing": (None, ErrorCode.BAD_FILE, []),
    "empty": (lambda: b"", ErrorCode.BAD_FILE, []),
    "text": (lambda: b"hello, I am a model", ErrorCode.BAD_FILE, []),
    "cut off": (lambda: MODEL.read_bytes()[:-1000], ErrorCode.BAD_FILE, []),
    "cut to its head": (lambda: MODEL.read_bytes()[:100], ErrorCode.BAD_FILE, []),
    "one weight changed": (
        lambda: MODEL.read_bytes()[:-5] + bytes([MODEL.read_bytes()[-5] ^ 1])
        + MODEL.read_bytes()[-4:], ErrorCode.BAD_FILE, ["SHA-256"]),
    "document edited": (
        lambda: edited(MODEL, lambda m: m["document"].update(duration_secs=1.0)), ErrorCode.BAD_FILE, ["SHA-256"]),
    "newer format": (
        lambda: edited(MODEL, lambda m: m.update(format_version=999)),
        ErrorCode.FORMAT_VERSION, ["999"]),
    "no robot": (
        lambda: (ROOT / "models" / "arcs.safetensors").read_bytes(),
        ErrorCode.ROBOT_MISMATCH, []),
}


@pytest.mark.parametrize("name", BAD_MODELS)
def test_a_bad_model_file_is_refused_and_the_old_model_serves_on(node, user, tmp_path, name):
    content, code, words = BAD_MODELS[name]
    path = tmp_path / "bad.safetensors"
    if content is not None:
        path.write_bytes(content())
    served = user.call(DescribePrimitive, "describe_primitive").model_id
    response = load(user, path)
    assert (response.error_code, response.model_id) == (code, served), response.error_message
    for word in [str(path), *words]:
        assert word in response.error_message
    user.hears("the old one stays")
    # The parameter is the same door.
    assert str(path) in user.try_parameter("model_path", str(path))
    assert user.parameter("model_path") == ""
    assert_still_serves(user)


@pytest.mark.parametrize("path", ["/dev/zero", "/", "/proc/self/mem", "a\nb"])
def test_a_path_that_is_no_file_is_refused_at_once(node, user, path):
    response = user.call(LoadModel, "load_model", path=path, timeout=2.0)
    assert response.error_code == ErrorCode.BAD_FILE and path in response.error_message


def test_a_good_model_file_is_loaded_by_service_and_by_parameter(node, user, tmp_path):
    copy = tmp_path / "copy.safetensors"
    shutil.copy(MODEL, copy)
    response = load(user, copy)
    assert response.error_code == ErrorCode.OK, response.error_message
    assert user.parameter("model_path") == str(copy)
    user.set_parameter("model_path", str(MODEL))
    assert_still_serves(user)
    user.set_parameter("model_path", "")
    assert_still_serves(user)


# ---- Starts that end at once ----

def ends(start, *arguments, **environment):
    """Starts the node, which ends by itself: its exit code and what it printed."""
    process = start("tcvae_node", *arguments, **environment)
    return process.wait(10.0), process.output


@pytest.mark.parametrize(("arguments", "code", "words"), [
    (["--frobnicate"], 2, ["--frobnicate", "--model"]),
    (["--ros-args", "-p", "sample.seed=3"], 2, ["NAME:=VALUE"]),
    (["-p", "sample.seed:=3"], 2, ["--ros-args -p"]),
    (["--ros-args", "-r", "__ns:=left"], 2, ["/left"]),
    (["--ros-args", "--params-file", "no/such.yaml"], 2, ["no/such.yaml"]),
    (["--ros-args", "-p", "task.tolerance_m:=9.0"], 2, ["9", "task.tolerance_m"]),
    (["--ros-args", "-p", "sample.max_tries:=many"], 2, ["a whole number, not a string"]),
    (["--model", "no/such.safetensors"], 3, ["BAD_FILE (51)", "no/such.safetensors"]),
    (["--urdf", "no/such.urdf"], 3, ["BAD_FILE (51)", "no/such.urdf"]),
    (["--urdf", str(ROOT / "Cargo.toml")], 3, ["BAD_FILE (51)", "URDF"]),
    (["--urdf", str(ROOT / "tests/fixtures/odd_arm.urdf")], 3, ["ROBOT_MISMATCH (50)"]),
    (["--ros-args", "-p", "base_frame:=moon"], 3, ["ROBOT_MISMATCH (50)", "moon"]),
    (["--robot", str(ROOT / "config/robots/baxter.toml"), "--ros-args", "-p", "base_frame:=moon"], 2,
     ["moon", "leave base_frame empty"]),
    (["--ros-args", "-p", "tip_link:=right_gripper"], 3, ["ROBOT_MISMATCH (50)", "right_s0"]),
])
def test_a_start_that_can_not_serve_says_why(start, arguments, code, words):
    status, output = ends(start, *arguments)
    assert status == code, output
    for word in words:
        assert word in output
    assert "panicked" not in output


@pytest.mark.parametrize("domain_id", ["233", "-1", "seven"])
def test_a_domain_that_does_not_exist_is_refused(start, domain_id):
    status, output = ends(start, ROS_DOMAIN_ID=domain_id)
    assert status == 2 and domain_id in output and "0 to 232" in output


def test_a_discovery_range_that_does_not_exist_is_refused(start):
    status, output = ends(start, ROS_AUTOMATIC_DISCOVERY_RANGE="GALAXY")
    assert status == 2 and "GALAXY" in output and "LOCALHOST" in output
