"""The node as a managed one beside rclpy's own lifecycle node, and what people look at: diagnostics and a ghost."""

import time
import xml.etree.ElementTree as ElementTree

import pytest
from conftest import start_node
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.srv import GetParameters
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tcvae_msgs.msg import ErrorCode
from tcvae_msgs.srv import SampleTrajectory
from user import LATCHED, User, pose, task

SOURCE = (0.60, 0.10)
GOAL = (0.65, 0.37)


def change(user, label="", number=0):
    return user.call(ChangeState, "change_state", transition=Transition(id=number, label=label)).success


def state(user):
    return user.call(GetState, "get_state").current_state.label


def plain(description):
    start, goal = description.start_state, description.goal_state
    return (description.transition.id, description.transition.label, start.id, start.label, goal.id, goal.label)


def ways(user, service="get_available_transitions"):
    return {plain(d) for d in user.call(GetAvailableTransitions, service).available_transitions}


def sample(user):
    return user.call(SampleTrajectory, "sample_trajectory", task=task(GOAL, SOURCE))


def test_an_inactive_node_answers_nothing_and_an_active_one_does(node, user):
    assert state(user) == "active"
    user.publish_location("source_cup", *SOURCE)
    assert change(user, "deactivate") and state(user) == "inactive"
    response = sample(user)
    assert response.error_code == ErrorCode.NOT_ACTIVE and not response.samples
    assert "ros2 lifecycle set /tcvae" in response.error_message
    user.goal_pose.publish(pose(*GOAL))
    user.hears("NOT_ACTIVE (61)")
    assert user.trajectory(timeout=0.5) is None
    assert change(user, number=Transition.TRANSITION_ACTIVATE)
    # Its task is still there.
    user.goal_pose.publish(pose(*GOAL))
    assert user.trajectory() is not None
    assert change(user, "deactivate") and change(user, "cleanup") and state(user) == "unconfigured"
    user.publish_location("source_cup", *SOURCE)
    user.hears("source_cup refused: NOT_ACTIVE (61)")
    assert change(user, "configure") and change(user, "activate")
    user.goal_pose.publish(pose(*GOAL))
    user.hears("NO_TASK (1)")
    assert change(user, "shutdown") and state(user) == "finalized"
    assert not change(user, "activate") and sample(user).error_code == ErrorCode.NOT_ACTIVE


def test_a_manager_brings_up_a_node_that_does_not_start_by_itself(start, make_client):
    start_node(start, "--ros-args", "-p", "autostart:=false")
    user = User(make_client("manager"))
    events = user.listen(TransitionEvent, "/tcvae/transition_event")
    user.wait(0.3)
    assert state(user) == "unconfigured" and sample(user).error_code == ErrorCode.NOT_ACTIVE
    assert not change(user, "activate") and not change(user, number=4)
    assert change(user, "configure") and change(user, "activate")
    assert sample(user).error_code == ErrorCode.OK
    user.until(lambda: len(events) == 4)
    assert [(e.start_state.label, e.goal_state.label) for e in events] == [
        ("unconfigured", "configuring"), ("configuring", "inactive"),
        ("inactive", "activating"), ("activating", "active")]
    assert [e.transition.label for e in events] == [
        "configure", "transition_success", "activate", "transition_success"]
    names = ["autostart"]
    assert user.call(GetParameters, "get_parameters", names=names).values[0].bool_value is False
    assert "fixed at start" in user.try_parameter("autostart", True)


def test_states_and_transitions_are_those_of_rclpys_lifecycle_node(node, user):
    other = LifecycleNode("theirs", context=user.client.context)
    user.client.executor.add_node(other)
    theirs = User.__new__(User)
    theirs.client, theirs.name, theirs.services = user.client, "/theirs", {}
    try:
        ours, its = ([(s.id, s.label) for s in u.call(GetAvailableStates, "get_available_states").available_states]
                     for u in (user, theirs))
        assert ours == its
        assert ways(user, "get_transition_graph") == ways(theirs, "get_transition_graph")
        for label in ("deactivate", "cleanup"):
            assert change(user, label)
        for label in ("configure", "activate", "deactivate", "cleanup", "shutdown"):
            assert state(user) == state(theirs)
            assert ways(user) == ways(theirs)
            assert change(user, label) == change(theirs, label) is True
        assert ways(user) == ways(theirs) == set()
    finally:
        user.client.executor.remove_node(other)
        other.destroy_node()


def test_diagnostics_come_once_a_second_and_tell_of_the_last_error(node, user):
    arrays = user.listen(DiagnosticArray, "/diagnostics")
    assert user.until(lambda: len(arrays) >= 2)
    seen, began = len(arrays), time.monotonic()
    assert user.until(lambda: len(arrays) >= seen + 3, 6.0)
    assert 1.5 < time.monotonic() - began < 4.5
    (status,) = arrays[-1].status
    assert status.name == "tcvae: serving" and status.hardware_id == "baxter"
    assert (status.level, status.message) == (DiagnosticStatus.OK, "active, pouring")
    values = {v.key: v.value for v in status.values}
    assert values["requests"] == "0" and values["last error"] == "none"
    assert sample(user).error_code == ErrorCode.OK
    bad = user.call(SampleTrajectory, "sample_trajectory", task=task((5.0, 0.3), SOURCE))
    assert bad.error_code == ErrorCode.OUT_OF_DISTRIBUTION
    seen = len(arrays)
    assert user.until(lambda: len(arrays) >= seen + 2)
    (status,) = arrays[-1].status
    values = {v.key: v.value for v in status.values}
    assert status.level == DiagnosticStatus.WARN and "OUT_OF_DISTRIBUTION (20)" in status.message
    assert (values["requests"], values["samples"], values["refused"]) == ("2", "1", "1")
    assert 0 < float(values["latency median, ms"]) < 1000
    assert values["state"] == "active" and len(values["model"]) == 12


def test_a_ghost_plays_the_motion_at_its_speed(node, user):
    ghost = user.listen(JointState, "/tcvae/preview/joint_states")
    descriptions = user.listen(String, "/tcvae/robot_description", LATCHED)
    assert user.until(lambda: descriptions)
    robot = ElementTree.fromstring(descriptions[0].data)
    movable = {j.get("name") for j in robot.findall("joint")
               if j.get("type") != "fixed" and j.find("mimic") is None}
    user.set_parameter("sample.speed", 2.0)
    user.publish_location("source_cup", *SOURCE)
    motion = user.ask(*GOAL)[0]
    seconds = motion.points[-1].time_from_start
    seconds = seconds.sec + 1e-9 * seconds.nanosec
    user.wait(seconds + 1.0)
    assert {name for message in ghost for name in message.name} == movable
    played = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in ghost]
    assert played[-1] - played[0] == pytest.approx(seconds, abs=0.3)
    assert len(ghost) == pytest.approx(30 * seconds, rel=0.2)
    places = [ghost[-1].name.index(name) for name in motion.joint_names]
    assert [ghost[-1].position[i] for i in places] == pytest.approx(list(motion.points[-1].positions))
    assert [ghost[0].position[i] for i in places] == pytest.approx(list(motion.points[0].positions), abs=0.05)
    # It rests then.
    count = len(ghost)
    user.wait(0.5)
    assert len(ghost) == count
    # And it stops where the node is deactivated.
    user.ask(*GOAL)
    user.wait(0.3)
    assert change(user, "deactivate")
    user.wait(0.1)
    count = len(ghost)
    user.wait(0.5)
    assert len(ghost) == count
