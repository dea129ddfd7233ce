"""Locations in other frames than the base: /tf and /tf_static from rclpy, and goals that come before or after them."""

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from pouring import Arm, Motion
from rclpy.qos import DurabilityPolicy, QoSProfile
from tcvae_msgs.msg import ErrorCode
from tcvae_msgs.srv import SampleTrajectory
from tf2_msgs.msg import TFMessage
from user import location, pose

STATIC = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SOURCE = (0.60, 0.10)
GOAL = (0.65, 0.37)
OTHER_GOAL = (0.72, 0.34)


@pytest.fixture(scope="module")
def arm():
    return Arm()


def stamp(secs):
    return Time(sec=int(secs), nanosec=round((secs - int(secs)) * 1e9))


def edge(parent, child, x=0.0, y=0.0, yaw=0.0, at=0.0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, stamp(at)
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation.z, message.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


def inside(frame, point):
    """A point of the base in the coordinates of a frame that stands at frame = (x, y, yaw)."""
    x, y, yaw = frame
    dx, dy = point[0] - x, point[1] - y
    return (math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy)


def assert_pours(message, arm, goal):
    motion = Motion(message)
    assert np.linalg.norm(motion.pour_location(arm) - goal) < 0.02
    assert np.linalg.norm(motion.source_cup(arm) - SOURCE) < 0.02


class Broadcaster:
    def __init__(self, user):
        node = user.client.node
        self.still = user.matched(node.create_publisher(TFMessage, "/tf_static", STATIC))
        self.moving = user.matched(node.create_publisher(TFMessage, "/tf", 100))
        self.user = user

    def static(self, *edges):
        self.still.publish(TFMessage(transforms=list(edges)))
        self.user.wait(0.1)

    def move(self, *edges):
        self.moving.publish(TFMessage(transforms=list(edges)))


@pytest.fixture
def tf(node, user):
    user.publish_location("source_cup", *SOURCE)
    return Broadcaster(user)


def goal_in(frame, point, at=0.0):
    message = pose(*point, frame=frame)
    message.header.stamp = stamp(at)
    return message


def test_a_goal_in_a_frame_that_stands_still(tf, user, arm):
    table = (0.4, -0.2, math.pi / 3)
    tf.static(edge("base", "table", *table), edge("table", "tray", 0.1))
    assert_pours(user.ask(*inside(table, GOAL), frame="table")[0], arm, GOAL)
    x, y = inside(table, OTHER_GOAL)
    assert_pours(user.ask(x - 0.1, y, frame="tray")[0], arm, OTHER_GOAL)
    user.publish_location("source_cup", *inside(table, SOURCE), frame="/table")
    assert_pours(user.ask(*GOAL)[0], arm, GOAL)


def test_a_goal_in_a_frame_that_moves_is_where_it_was_at_its_stamp(tf, user, arm):
    # The base hangs on what moves, too, as on a mobile robot.
    tf.static(edge("world", "base", 1.0, 2.0))
    for i in range(20):
        at = 100.0 + 0.1 * i
        tf.move(edge("world", "belt", 1.0 + 0.1 * i, 2.0, at=at))
    user.wait(0.2)
    # At 101.15 s it is at 0.115 * 10 = 1.15 m along x in the base.
    user.goal_pose.publish(goal_in("belt", (GOAL[0] - 1.15, GOAL[1]), 101.15))
    assert_pours(user.trajectory(), arm, GOAL)
    # Stamp 0 is the latest: 1.9 m.
    assert_pours(user.ask(GOAL[0] - 1.9, GOAL[1], frame="belt")[0], arm, GOAL)
    user.goal_pose.publish(goal_in("belt", GOAL, 99.0))
    user.hears("TRANSFORM_FAILED (12)")
    user.hears('"belt" is known from 100.000 to 101.900 s, and asked for at 99.000 s')


def test_a_goal_waits_for_its_transform_and_a_later_one_is_not_overtaken(tf, user, arm):
    user.goal_pose.publish(goal_in("cup", (0.05, 0.07)))
    user.wait(0.2)
    tf.static(edge("base", "cup", GOAL[0] - 0.05, GOAL[1] - 0.07))
    assert_pours(user.trajectory(), arm, GOAL)
    # One that waits is given up for the next one on its topic.
    user.goal_pose.publish(goal_in("nowhere", GOAL))
    user.goal_pose.publish(pose(*OTHER_GOAL))
    user.wait(1.0)
    assert_pours(user.joints[-1], arm, OTHER_GOAL)
    assert len(user.joints) == 2
    user.hears("a later one took its place")
    # What the goal needs is not overtaken by it either.
    user.locations["source_cup"].publish(location("source_cup", 0.01, 0.02, frame="saucer").point)
    user.wait(0.1)
    user.goal_pose.publish(pose(*GOAL))
    user.wait(0.1)
    tf.move(edge("base", "saucer", SOURCE[0] - 0.01, SOURCE[1] - 0.02, at=7.0))
    user.wait(0.5)
    assert_pours(user.joints[-1], arm, GOAL)


def test_a_quick_succession_of_locations_comes_to_its_turn(tf, user, arm):
    user.publish_location("source_cup", SOURCE[0], SOURCE[1] - 0.08)
    late = 5  # messages until a transform comes
    for i in range(40):
        cup = location("source_cup", SOURCE[0] - 0.1, SOURCE[1], frame="belt").point
        cup.header.stamp = stamp(100 + 0.02 * i)
        user.locations["source_cup"].publish(cup)
        if i >= late:
            tf.move(edge("base", "belt", 0.1, at=100 + 0.02 * (i - late)))
        user.wait(0.02)
    assert_pours(user.ask(*GOAL)[0], arm, GOAL)


def sample(user, frame, point, at=0.0):
    there = location("pour_location", *point, frame=frame)
    there.point.header.stamp = stamp(at)
    task = [there, location("source_cup", *SOURCE)]
    return user.call(SampleTrajectory, "sample_trajectory", task=task)


def test_requests_name_what_is_missing(tf, user, arm):
    response = sample(user, "cup", GOAL)
    assert response.error_code == ErrorCode.FRAME_UNKNOWN
    for word in ['"cup"', "neither /tf nor /tf_static was heard", "waited for 0.5 s", '"base"']:
        assert word in response.error_message
    tf.static(edge("base", "table", 0.1), edge("room", "door", 0.1))
    response = sample(user, "cup", GOAL)
    assert response.error_code == ErrorCode.FRAME_UNKNOWN
    assert "base, door, room, table" in response.error_message
    response = sample(user, "door", GOAL)
    assert response.error_code == ErrorCode.TRANSFORM_FAILED
    assert "nothing connects them" in response.error_message
    user.set_parameter("tf.timeout_s", 5.0)
    # While one request waits, others are answered.
    call = SampleTrajectory.Request(task=[location("pour_location", 0.55, 0.37, frame="late"),
                                          location("source_cup", *SOURCE)])
    client = user.client.service(SampleTrajectory, "/tcvae/sample_trajectory")
    waiting = client.call_async(call)
    assert sample(user, "table", (GOAL[0] - 0.1, GOAL[1])).error_code == ErrorCode.OK
    assert not waiting.done()
    tf.static(edge("base", "late", 0.1))
    assert user.until(waiting.done, 2.0)
    answer = waiting.result()
    assert answer.error_code == ErrorCode.OK, answer.error_message
    assert_pours(answer.samples[0].joint_trajectory, arm, GOAL)


def test_transforms_that_are_none_are_left_out_and_told_once(tf, user, arm):
    broken = edge("base", "table", float("nan"))
    unturned = edge("base", "table")
    unturned.transform.rotation.w = 0.0
    for _ in range(20):
        tf.move(broken, unturned, edge("table", "table", 0.1), edge("base", "table", 0.1, at=3.0))
    user.hears("a transform of \"table\" is left out")
    assert_pours(user.ask(GOAL[0] - 0.1, GOAL[1], frame="table")[0], arm, GOAL)
    complaints = lambda: [m.msg for m in user.log if "is left out" in m.msg]
    assert user.until(lambda: len(set(complaints())) == 3), complaints()
    assert len(complaints()) == 3, complaints()
