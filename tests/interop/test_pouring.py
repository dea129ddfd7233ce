"""Goal poses in, trajectories out: what the node serves, measured again from outside."""

import json
import subprocess

import numpy as np
import pytest
from conftest import BINARIES, ROOT, start_node
from nav_msgs.msg import Path
from pouring import Arm, Motion, seconds
from rcl_interfaces.msg import ParameterEvent
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tcvae_msgs.srv import DescribePrimitive, SampleTrajectory, SetManner
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from user import User, plain, pose, task
from visualization_msgs.msg import Marker, MarkerArray

TOLERANCE_M = 0.02
SOURCE = (0.60, 0.10)
# As far from the cup as people pour: 0.25 to 0.3 m.
GOALS = [(0.65, 0.37), (0.72, 0.34), (0.60, 0.38)]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope="module")
def arm():
    return Arm()


def assert_pours(message, arm, goal, source=SOURCE):
    motion = Motion(message)
    motion.assert_executable(arm)
    assert np.linalg.norm(motion.pour_location(arm) - goal) < TOLERANCE_M
    assert np.linalg.norm(motion.source_cup(arm) - source) < TOLERANCE_M
    return motion


def test_a_goal_pose_becomes_a_trajectory_that_pours_there(node, user, arm):
    user.publish_location("source_cup", *SOURCE)
    for goal in GOALS:
        joints, poses, path = user.ask(*goal)
        motion = assert_pours(joints, arm, goal)
        assert len(motion.times) == 100
        assert (joints.header.stamp.sec, joints.header.stamp.nanosec) == (0, 0)
        # The other two messages show the same motion.
        assert poses.header.frame_id == path.header.frame_id == "base"
        assert list(poses.joint_names) == ["left_gripper"]
        assert len(poses.points) == len(path.poses) == 100
        for point, pose, positions in zip(poses.points, path.poses, motion.positions):
            tip = arm.forward(positions)
            place = point.transforms[0].translation
            assert np.allclose([place.x, place.y, place.z], tip[:3, 3], atol=1e-6)
            assert pose.pose.position.x == place.x
            turn = point.transforms[0].rotation
            # A unit quaternion's double cover: compare what it does to an axis.
            x, y, z, w = turn.x, turn.y, turn.z, turn.w
            up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
            assert np.allclose(up, tip[:3, 2], atol=1e-6)
        assert [seconds(p.time_from_start) for p in poses.points] == list(motion.times)


def test_height_and_orientation_of_a_goal_have_no_meaning(node, user, arm):
    user.publish_location("source_cup", *SOURCE)
    goal = pose(*GOALS[0])
    goal.pose.position.z = float("nan")
    goal.pose.orientation.w = 0.0
    user.goal_pose.publish(goal)
    assert_pours(user.trajectory(), arm, GOALS[0])


def test_manner_set_by_the_service_changes_the_motion_and_not_its_place(node, user, arm):
    assert_manner_matters(user, arm, lambda name, value: set_by_service(user, name, value))


def test_manner_set_by_a_parameter_changes_the_motion_and_not_its_place(node, user, arm):
    assert_manner_matters(user, arm, lambda name, value: user.set_parameter(
        f"manner.{name}", value))


def set_by_service(user, name, value):
    response = user.call(SetManner, "set_manner", names=[name], values=[value])
    assert response.error_code == 0, response.error_message
    assert {m.name: m.value for m in response.manner}[name] == value


def assert_manner_matters(user, arm, set_manner):
    user.publish_location("source_cup", *SOURCE)
    before = assert_pours(user.ask(*GOALS[0])[0], arm, GOALS[0])
    again = assert_pours(user.ask(*GOALS[0])[0], arm, GOALS[0])
    assert np.array_equal(before.positions, again.positions)
    description = user.call(DescribePrimitive, "describe_primitive")
    changed = []
    for axis in description.manner:
        set_manner(axis.name, 0.8)
        user.goal_pose.publish(pose(*GOALS[0]))
        joints = user.trajectory()
        if joints is None:
            # A manner of an extreme pour may break a bound of validity; then it is not served.
            assert user.said("INVALID_MOTION"), [m.msg for m in user.log]
        else:
            after = assert_pours(joints, arm, GOALS[0])
            changed.append(np.abs(after.positions - before.positions).max())
        set_manner(axis.name, 0.0)
    print("largest change of a joint by manner parameter, rad:", np.round(changed, 3))
    assert len(changed) >= 2 and sorted(changed)[-2] > 0.02


def test_both_ways_to_set_manner_are_one(node, user):
    axis = user.call(DescribePrimitive, "describe_primitive").manner[0].name
    events = user.listen(ParameterEvent, "/parameter_events")
    set_by_service(user, axis, 0.5)
    assert user.parameter(f"manner.{axis}")== 0.5
    named = lambda: [(p.name, plain(p.value)) for e in events for p in e.changed_parameters]
    assert user.until(lambda: (f"manner.{axis}", 0.5) in named())
    user.set_parameter(f"manner.{axis}", -0.25)
    response = user.call(SetManner, "set_manner")
    assert {m.name: m.value for m in response.manner}[axis] == -0.25
    assert user.call(SetManner, "set_manner", reset=True).error_code == 0
    assert user.parameter(f"manner.{axis}")== 0.0


def test_the_service_returns_12_samples_of_100_points(node, user, arm):
    request = dict(task=task(GOALS[0], SOURCE), count=12, sample_manner=True, seed=7)
    response = user.call(SampleTrajectory, "sample_trajectory", **request)
    assert response.error_code == 0, response.error_message
    assert len(response.samples) == 12
    for sample in response.samples:
        motion = assert_pours(sample.joint_trajectory, arm, GOALS[0])
        assert len(motion.times) == len(sample.position_stddev) == 100
        measured = {l.name: (l.point.point.x, l.point.point.y) for l in sample.empirical_task}
        found = np.linalg.norm(motion.pour_location(arm) - measured["pour_location"])
        assert found < 0.003, "the node's measure of the pour and ours differ"
        assert 0 <= sample.task_error <= TOLERANCE_M
        # A joint may touch its limit, and not leave it.
        assert sample.joint_margin >= 0 and sample.slowdown >= 1 and sample.tries >= 1
    manners = {tuple(sample.manner_values) for sample in response.samples}
    assert len(manners) == 12
    again = user.call(SampleTrajectory, "sample_trajectory", **request)
    for first, second in zip(response.samples, again.samples):
        # As text, since the clearance is NaN, which equals nothing.
        assert str(first) == str(second), "one seed gave two motions"
    # Each sample names the seed that makes it alone.
    one = user.call(SampleTrajectory, "sample_trajectory",
                    **request | {"count": 1, "seed": response.samples[5].seed})
    assert one.samples[0].manner_values == response.samples[5].manner_values


@pytest.mark.parametrize(("rank_by", "cost"), [
    ("duration", lambda sample: seconds(sample.joint_trajectory.points[-1].time_from_start)),
    ("margin", lambda sample: -sample.joint_margin),
])
def test_samples_come_in_the_order_that_is_asked_for(node, user, rank_by, cost):
    response = user.call(SampleTrajectory, "sample_trajectory", task=task(GOALS[0], SOURCE),
                         count=8, sample_manner=True, rank_by=rank_by)
    costs = [cost(sample) for sample in response.samples]
    assert len(costs) == 8 and costs == sorted(costs)


def test_slower_limits_make_a_slower_motion_at_the_same_place(node, user, arm):
    request = task(GOALS[0], SOURCE)
    normal = user.call(SampleTrajectory, "sample_trajectory", task=request).samples[0]
    slow = user.call(SampleTrajectory, "sample_trajectory", task=request,
                     velocity_scale=0.05).samples[0]
    motion = assert_pours(slow.joint_trajectory, arm, GOALS[0])
    assert slow.slowdown > normal.slowdown
    assert np.all(np.abs(motion.velocities) <= 0.05 * arm.velocity * (1 + 1e-6))


def test_a_rate_decides_the_number_of_points(node, user):
    request = task(GOALS[0], SOURCE)
    sample = user.call(SampleTrajectory, "sample_trajectory", task=request, rate_hz=50.0).samples[0]
    times = [seconds(point.time_from_start) for point in sample.joint_trajectory.points]
    assert np.allclose(np.diff(times), 1 / 50, atol=2e-3)


def test_a_request_can_publish_its_first_sample(node, user):
    response = user.call(SampleTrajectory, "sample_trajectory", count=3, publish=True,
                         sample_manner=True, task=task(GOALS[0], SOURCE))
    published = user.trajectory()
    assert published == response.samples[0].joint_trajectory
    user.call(SampleTrajectory, "sample_trajectory", task=task(GOALS[0], SOURCE))
    assert user.trajectory(timeout=0.5) is None


def test_trigger_samples_for_the_latest_task_and_publishes(node, user, arm):
    user.publish_location("source_cup", *SOURCE)
    user.publish_location("pour_location", *GOALS[1])
    assert user.trajectory(timeout=0.5) is None, "a task topic asked for a trajectory by itself"
    response = user.call(Trigger, "sample")
    assert response.success and "100 points" in response.message, response.message
    assert_pours(user.trajectory(), arm, GOALS[1])


def test_publish_on_task_makes_every_task_topic_ask(node, user, arm):
    user.set_parameter("publish_on_task", True)
    user.publish_location("pour_location", *GOALS[1])
    user.hears("NO_TASK")
    user.publish_location("source_cup", *SOURCE)
    assert_pours(user.trajectory(), arm, GOALS[1])


def test_the_default_of_a_location_stands_in_until_one_is_published(node, user, arm):
    user.set_parameter("task.source_cup.default", SOURCE)
    assert_pours(user.ask(*GOALS[0])[0], arm, GOALS[0])
    user.publish_location("source_cup", 0.65, 0.05)
    assert_pours(user.ask(*GOALS[0])[0], arm, GOALS[0], source=(0.65, 0.05))


def test_markers_show_the_path_its_band_and_the_task(node, user, make_client):
    user.publish_location("source_cup", *SOURCE)
    assert user.ask(*GOALS[0])[0] is not None
    late = make_client("viewer")
    arrays = []
    late.node.create_subscription(MarkerArray, "/tcvae/markers", arrays.append, LATCHED)
    assert late.spin_until(lambda: arrays, 5.0) is not None
    first, *markers = arrays[0].markers
    assert first.action == Marker.DELETEALL
    assert {m.header.frame_id for m in markers} == {"base"} and {m.action for m in markers} == {Marker.ADD}
    assert len({(m.ns, m.id) for m in markers}) == len(markers)
    by_name = {m.ns: m for m in markers}
    poses = user.paths[-1].poses
    path = np.array([[p.x, p.y, p.z] for p in by_name["path"].points])
    assert np.allclose(path, [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses])
    assert by_name["path"].scale.x > 0 and by_name["path"].color.a == 1.0
    request = SampleTrajectory.Request(task=task(GOALS[0], SOURCE))
    response, _ = late.call(late.service(SampleTrajectory, "/tcvae/sample_trajectory"), request)
    stddev = np.array(response.samples[0].position_stddev)
    band = by_name["band"]
    corners = np.array([[p.x, p.y, p.z] for p in band.points])
    assert band.type == Marker.TRIANGLE_LIST and len(corners) % 3 == 0 and 0 < band.color.a < 1
    away = np.linalg.norm(corners[:, None] - path[None], axis=2).min(axis=1)
    # 95 % of a normal distribution lie inside.
    assert stddev.min() > 0 and 2 * stddev.min() < away.max() <= 2.8 * stddev.max() + 1e-9
    disc = by_name["pour_location"]
    assert (disc.pose.position.x, disc.pose.position.y) == GOALS[0] and disc.scale.x == 0.04
    reached = by_name["pour_location/reached"].pose.position
    assert 0 < np.hypot(reached.x - GOALS[0][0], reached.y - GOALS[0][1]) < 0.02


def test_who_joins_late_gets_no_old_trajectory_but_the_model_and_the_path(node, user, make_client):
    user.publish_location("source_cup", *SOURCE)
    assert user.ask(*GOALS[0])[0] is not None
    late = make_client("late")
    got = {"joints": [], "poses": [], "path": [], "info": []}
    for key, kind, topic, qos in [
        ("joints", JointTrajectory, "joint_trajectory", 10),
        ("poses", MultiDOFJointTrajectory, "end_effector_trajectory", 10),
        ("path", Path, "end_effector_path", LATCHED),
        ("info", String, "model_info", LATCHED),
    ]:
        late.node.create_subscription(kind, f"/tcvae/{topic}", got[key].append, qos)
    assert late.spin_until(lambda: got["info"] and got["path"], 5.0) is not None
    late.spin_until(lambda: False, 1.0)
    assert (len(got["joints"]), len(got["poses"])) == (0, 0)
    info = json.loads(got["info"][0].data)
    description = user.call(DescribePrimitive, "describe_primitive")
    assert info["model_id"] == description.model_id
    assert [axis["name"] for axis in info["manner"]] == [m.name for m in description.manner]
    assert info["joint_names"] == list(description.joint_names)
    assert info["evaluation"] == json.loads(description.evaluation_json)
    assert info["synthetic_data"] is True
    assert (info["primitive"], info["method"]) == ("pouring", "TC-VAE")


def test_20_fresh_clients_one_after_another_are_all_served(node, make_client, arm):
    took = []
    for number in range(20):
        client = make_client(f"fresh_{number}")
        service = client.service(SampleTrajectory, "/tcvae/sample_trajectory")
        request = SampleTrajectory.Request(count=1, task=task(GOALS[0], SOURCE))
        response, seconds_taken = client.call(service, request)
        assert response.error_code == 0, response.error_message
        assert len(response.samples[0].joint_trajectory.points) == 100
        took.append(round(seconds_taken, 4))
        client.close()
    print("first calls, s:", took)


def test_goals_in_a_burst_end_with_the_last_one(node, user, arm):
    user.publish_location("source_cup", *SOURCE)
    for i in range(30):
        user.goal_pose.publish(pose(0.62 + 0.001 * i, 0.37))
    last = (0.72, 0.34)
    user.goal_pose.publish(pose(*last))
    user.wait(1.0)
    assert not user.said("BUSY")
    assert_pours(user.joints[-1], arm, last)
    places = [Motion(joints).pour_location(arm)[0] for joints in user.joints]
    assert all(later > earlier for earlier, later in zip(places, places[1:]))


# ---- A model of one's own, on a description of one's own ----

QUIRKS = ROOT / "tests" / "fixtures" / "baxter_quirks.urdf"


@pytest.fixture(scope="module")
def fresh_model(tmp_path_factory):
    """A model trained just now, from a few demonstrations for a short time."""
    folder = tmp_path_factory.mktemp("fresh")
    model = folder / "model.safetensors"
    for arguments in [
        ["simulate", "pouring", "--seed", "5", "--count", "80", "-o", folder / "pours"],
        ["train", folder / "pours", "--set", "epochs=8", "-o", model],
    ]:
        done = subprocess.run([BINARIES / "tcvae", *arguments], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return model


def test_a_freshly_trained_model_is_served_on_a_second_description_of_the_arm(
    start, make_client, fresh_model,
):
    process = start_node(start, "--model", str(fresh_model), "--urdf", str(QUIRKS))
    assert str(fresh_model) in process.output and str(QUIRKS) in process.output
    arm = Arm(QUIRKS)
    user = User(make_client("user"))
    user.publish_location("source_cup", *SOURCE)
    served = 0
    for goal in GOALS:
        user.goal_pose.publish(pose(*goal))
        joints = user.trajectory(timeout=3.0)
        if joints is not None:
            assert_pours(joints, arm, goal)
            served += 1
    assert served > 0, [m.msg for m in user.log]
