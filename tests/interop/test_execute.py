"""~/execute beside an rclpy action server, with FollowJointTrajectory servers that behave, and that don't."""

import json
import os
import signal
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from conftest import Process, start_node, wait_until
from controller import ACTION, START
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from pouring import Arm, Motion
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from tcvae_msgs.action import Execute
from tcvae_msgs.msg import ErrorCode
from tcvae_msgs.srv import SampleTrajectory
from trajectory_msgs.msg import JointTrajectory
from unique_identifier_msgs.msg import UUID
from user import LATCHED, User, task

SOURCE = (0.60, 0.10)
GOAL = (0.65, 0.37)
HERE = Path(__file__).resolve().parent


class Controller(Process):
    """controller.py as a process."""

    def __init__(self, domain, behaviour, speed):
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        super().__init__(Path(sys.executable), [HERE / "controller.py", behaviour, str(speed)], environment)
        assert wait_until(lambda: self.events("ready"), 20.0) is not None, self.output

    def events(self, kind):
        lines = [json.loads(line) for line in list(self.lines) if line.startswith("{")]
        return [line for line in lines if line["event"] == kind]


@pytest.fixture
def controller(domain):
    """Starts controllers: controller("follow", speed)."""
    started = []

    def start_controller(behaviour, speed=20.0):
        started.append(Controller(domain, behaviour, speed))
        return started[-1]

    yield start_controller
    for process in started:
        process.kill()
        print(f"--- output of the controller {process.pid}\n{process.output[-3000:]}")


class Executor:
    """A client of ~/execute."""

    def __init__(self, client, name="/tcvae/execute"):
        self.client, self.feedback = client, []
        self.action = ActionClient(client.node, Execute, name)
        assert self.action.wait_for_server(10.0)
        self.client.spin_until(lambda: False, 0.3)

    def until(self, future, timeout=30.0):
        assert self.client.spin_until(future.done, timeout) is not None, "no answer"
        return future.result()

    def send(self, **fields):
        fields.setdefault("task", task(GOAL, SOURCE))
        goal = Execute.Goal(**fields)
        return self.until(self.action.send_goal_async(goal, lambda f: self.feedback.append(f.feedback)))

    def result(self, handle, timeout=30.0):
        return self.until(handle.get_result_async(), timeout)

    def run(self, **fields):
        """Status and result of a goal."""
        handle = self.send(**fields)
        assert handle.accepted
        answer = self.result(handle)
        return answer.status, answer.result

    def until_driven(self):
        assert self.client.spin_until(
            lambda: any(f.stage in ("approaching", "executing") for f in self.feedback), 10.0) is not None


def hears_joints(client):
    """Waits until the node knows where the arm is."""
    sample = client.service(SampleTrajectory, "/tcvae/sample_trajectory")

    def is_known():
        response, _ = client.call(sample, SampleTrajectory.Request(task=task(GOAL, SOURCE)))
        return response.samples and not any("no joint states" in w for w in response.samples[0].warnings)

    assert wait_until(is_known, 10.0, every=0.1) is not None


def ready(start, make_client, *arguments):
    """A client of a node that knows where the arm is."""
    start_node(start, *arguments)
    executor = Executor(make_client())
    hears_joints(executor.client)
    return executor


def test_a_goal_is_sampled_approached_and_driven_to_its_end(controller, start, make_client):
    robot = controller("follow")
    start_node(start)
    user = User(make_client())
    published = user.listen(JointTrajectory, "/tcvae/joint_trajectory")
    executor = Executor(user.client)
    hears_joints(user.client)
    status, result = executor.run(seed=5)
    assert (status, result.error_code, result.error_message) == (GoalStatus.STATUS_SUCCEEDED, 0, "")
    (goal,), (end,) = robot.events("goal"), robot.events("end")
    assert end["how"] == "succeeded" and goal["stamp"] == 0
    # What was driven is what was checked and told.
    driven = result.sample.joint_trajectory
    assert goal["joints"] == driven.joint_names
    assert np.array_equal(goal["positions"], [p.positions for p in driven.points])
    # It began where the arm stood, and the primitive later.
    begin = dict(zip(goal["joints"], goal["positions"][0]))
    assert max(abs(begin[name] - START[name]) for name in START) < 0.05
    assert result.sample.primitive_start_index > 3
    arm = Arm()
    # The way there is tilted, too.
    driven.points = driven.points[result.sample.primitive_start_index:]
    motion = Motion(driven)
    assert np.linalg.norm(motion.pour_location(arm) - GOAL) < 0.02
    stages = [f.stage for f in executor.feedback]
    assert stages[0] == "sampling" and stages == sorted(stages, key=["sampling", "approaching", "executing"].index)
    progress = [f.progress for f in executor.feedback]
    assert progress == sorted(progress) and progress[-1] == 1.0 and executor.feedback[-1].stage == "executing"
    assert abs(executor.feedback[-1].max_tracking_error - 0.01) < 1e-9
    # Who listens to the topic, too, must not drive it a second time.
    user.wait(0.3)
    assert published == [] and len(user.paths) == 1
    # The next one begins where this one ended.
    user.wait(0.3)
    status, again = executor.run(seed=6)
    assert status == GoalStatus.STATUS_SUCCEEDED
    first = robot.events("goal")[1]["positions"][0]
    assert max(abs(np.array(first) - goal["positions"][-1])) < 0.1


def test_a_rejected_motion_is_told(controller, start, make_client):
    robot = controller("reject")
    executor = ready(start, make_client)
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_REJECTED)
    assert ACTION in result.error_message and "rejected the motion" in result.error_message
    assert len(robot.events("goal")) == 1


def test_an_aborted_motion_is_told_with_the_controllers_words(controller, start, make_client):
    controller("abort")
    executor = ready(start, make_client)
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_ABORTED)
    assert "PATH_TOLERANCE_VIOLATED: left_s0 is 0.3 rad off" in result.error_message
    assert "deviation of a joint was 0.010 rad" in result.error_message
    assert len(result.sample.joint_trajectory.points) > 50


def test_a_controller_that_stalls_is_told_to_stop(controller, start, make_client):
    robot = controller("stall")
    executor = ready(start, make_client, "--ros-args", "-p", "execute.grace_s:=0.0")
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_ABORTED)
    assert "has not ended the motion" in result.error_message and "execute.grace_s" in result.error_message
    assert [e["how"] for e in robot.events("end")] == ["canceled"]


def test_cancelling_stops_the_robot(controller, start, make_client):
    robot = controller("stall")
    executor = ready(start, make_client)
    handle = executor.send()
    executor.until_driven()
    answer = executor.until(handle.cancel_goal_async())
    assert answer.return_code == CancelGoal.Response.ERROR_NONE and len(answer.goals_canceling) == 1
    done = executor.result(handle)
    assert (done.status, done.result.error_code) == (GoalStatus.STATUS_CANCELED, 0)
    assert [e["how"] for e in robot.events("end")] == ["canceled"]
    # The arm is free for the next goal.
    second = executor.send()
    executor.until_driven()
    executor.until(second.cancel_goal_async())
    assert executor.result(second).status == GoalStatus.STATUS_CANCELED


def test_a_controller_that_does_not_stop_is_told_of(controller, start, make_client):
    robot = controller("deaf")
    executor = ready(start, make_client, "--ros-args", "-p", "execute.timeout_s:=1.0")
    handle = executor.send()
    executor.until_driven()
    executor.until(handle.cancel_goal_async())
    done = executor.result(handle)
    assert (done.status, done.result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_ABORTED)
    assert "the arm may still move" in done.result.error_message
    assert len(robot.events("cancel")) >= 2 and robot.events("end") == []


def test_a_controller_that_accepts_too_late_drives_nothing(controller, start, make_client):
    robot = controller("slow", speed=1.0)
    executor = ready(start, make_client, "--ros-args", "-p", "execute.timeout_s:=1.0")
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_REJECTED)
    assert "did not answer within 1.0 s" in result.error_message
    assert wait_until(lambda: robot.events("end"), 8.0) is not None
    (end,) = robot.events("end")
    assert end["how"] == "canceled" and end["at"] < 1.0
    assert len(robot.events("goal")) == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_controller_that_dies_is_missed(controller, start, make_client, number):
    robot = controller("stall")
    executor = ready(start, make_client, "--ros-args", "-p", "execute.grace_s:=0.0", "-p", "execute.timeout_s:=1.0")
    handle = executor.send()
    executor.until_driven()
    robot.signal(number)
    done = executor.result(handle)
    assert (done.status, done.result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_ABORTED)
    left, silent = "nobody knows what the arm does now", "the arm may still move"
    assert any(words in done.result.error_message for words in (left, silent)), done.result.error_message
    # A controller that comes back gets the next goal, and no other.
    again = controller("follow")
    executor.client.spin_until(lambda: False, 1.2)
    hears_joints(executor.client)
    status, _ = executor.run()
    assert status == GoalStatus.STATUS_SUCCEEDED and len(again.events("goal")) == 1


def test_a_second_goal_is_busy_while_one_drives(controller, start, make_client):
    robot = controller("stall")
    executor = ready(start, make_client)
    first = executor.send()
    executor.until_driven()
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.BUSY)
    assert "another goal is driving" in result.error_message
    executor.until(first.cancel_goal_async())
    assert executor.result(first).status == GoalStatus.STATUS_CANCELED
    assert len(robot.events("goal")) == 1


def test_where_the_arm_is_must_be_known(start, make_client):
    start_node(start)
    executor = Executor(make_client())
    status, result = executor.run()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.STALE_JOINT_STATE)
    status, result = executor.run(start_policy="ignore")
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.CONTROLLER_REJECTED)
    assert f"nobody serves the action {ACTION}" in result.error_message
    status, result = executor.run(start_policy="jump")
    assert result.error_code == ErrorCode.BAD_REQUEST and "approach, refuse or ignore" in result.error_message
    status, result = executor.run(task=task((5.0, 0.3), SOURCE), start_policy="ignore")
    assert result.error_code == ErrorCode.OUT_OF_DISTRIBUTION


def test_the_controller_is_a_parameter(controller, start, make_client):
    controller("follow")
    start_node(start, "--ros-args", "-p", "execute.controller:=~/follow", "-p", "execute.timeout_s:=0.5")
    user = User(make_client())
    executor = Executor(user.client)
    hears_joints(user.client)
    _, result = executor.run()
    assert result.error_code == ErrorCode.CONTROLLER_REJECTED
    assert "/tcvae/follow" in result.error_message and f"there is {ACTION}" in result.error_message
    assert "digit" in user.try_parameter("execute.controller", "/1bad/name")
    user.set_parameter("execute.controller", "")
    _, result = executor.run()
    assert "no controller is set" in result.error_message
    user.set_parameter("execute.controller", ACTION)
    user.wait(0.5)
    status, _ = executor.run()
    assert status == GoalStatus.STATUS_SUCCEEDED


def test_an_inactive_node_drives_nothing_and_one_that_ends_stops_the_arm(controller, start, make_client):
    robot = controller("stall")
    process = start_node(start)
    user = User(make_client())
    executor = Executor(user.client)
    hears_joints(user.client)

    def change(number):
        return user.call(ChangeState, "change_state", transition=Transition(id=number)).success

    handle = executor.send()
    executor.until_driven()
    assert change(Transition.TRANSITION_DEACTIVATE)
    done = executor.result(handle)
    assert (done.status, done.result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.NOT_ACTIVE)
    assert [e["how"] for e in robot.events("end")] == ["canceled"]
    _, result = executor.run()
    assert result.error_code == ErrorCode.NOT_ACTIVE and len(robot.events("goal")) == 1
    assert change(Transition.TRANSITION_ACTIVATE)
    executor.feedback.clear()
    executor.send()
    executor.until_driven()
    assert process.interrupt() == 0
    assert wait_until(lambda: len(robot.events("end")) == 2, 5.0) is not None
    assert robot.events("end")[1]["how"] == "canceled"


# ---- The protocol, beside rclpy's own server ----


class Theirs:
    """An rclpy server of the same action, whose goals run until they are canceled, or end at once with a seed."""

    def __init__(self, client):
        self.client = client
        self.server = ActionServer(
            client.node, Execute, "/theirs/execute", execute_callback=self.execute,
            cancel_callback=lambda _: CancelResponse.ACCEPT, callback_group=ReentrantCallbackGroup())

    async def execute(self, handle):
        if handle.request.start_policy == "jump":
            handle.abort()
            return Execute.Result(error_code=ErrorCode.BAD_REQUEST)
        while not handle.is_cancel_requested:
            moment = Future(executor=self.client.executor)
            timer = self.client.node.create_timer(0.02, lambda: moment.done() or moment.set_result(None))
            await moment
            timer.destroy()
        handle.canceled()
        return Execute.Result()


@pytest.fixture(params=["ours", "theirs"])
def server(request, controller, start, make_client):
    """The name of a server of ~/execute, and a client: ours, and rclpy's."""
    client = make_client("user")
    if request.param == "ours":
        controller("stall")
        start_node(start)
        name = "/tcvae/execute"
    else:
        name = "/theirs/execute"
        client.theirs = Theirs(client)
    executor = Executor(client, name)
    client.spin_until(lambda: False, 0.5)
    if request.param == "ours":
        hears_joints(client)
    return executor, name


def raw(executor, name, kind, service):
    return executor.client.service(kind, f"{name}/_action/{service}")


def test_unknown_goals_and_second_results_are_answered_as_by_rclpy(server):
    executor, name = server
    results = raw(executor, name, Execute.Impl.GetResultService, "get_result")
    cancels = raw(executor, name, CancelGoal, "cancel_goal")
    sends = raw(executor, name, Execute.Impl.SendGoalService, "send_goal")
    unknown = UUID(uuid=list(uuid.uuid4().bytes))
    answer, took = executor.client.call(results, Execute.Impl.GetResultService.Request(goal_id=unknown))
    assert answer.status == GoalStatus.STATUS_UNKNOWN and took < 2.0
    cancel = CancelGoal.Request(goal_info=GoalInfo(goal_id=unknown))
    answer, took = executor.client.call(cancels, cancel)
    assert answer.return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID and took < 2.0
    assert not answer.goals_canceling

    known = UUID(uuid=list(uuid.uuid4().bytes))
    request = Execute.Impl.SendGoalService.Request(goal_id=known, goal=Execute.Goal(start_policy="jump"))
    assert executor.client.call(sends, request)[0].accepted
    for _ in range(2):
        answer, _ = executor.client.call(results, Execute.Impl.GetResultService.Request(goal_id=known))
        assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.BAD_REQUEST)
    # Its id is taken, and it can't be canceled any more.
    assert not executor.client.call(sends, request)[0].accepted
    answer, _ = executor.client.call(cancels, CancelGoal.Request(goal_info=GoalInfo(goal_id=known)))
    assert answer.return_code == CancelGoal.Response.ERROR_GOAL_TERMINATED


def test_states_are_latched_and_all_goals_can_be_canceled_as_at_rclpys(server):
    executor, name = server
    early = []
    executor.client.node.create_subscription(
        GoalStatusArray, f"{name}/_action/status", early.append, LATCHED)
    handle = executor.send()
    executor.client.spin_until(lambda: False, 0.7)
    cancels = raw(executor, name, CancelGoal, "cancel_goal")
    answer, _ = executor.client.call(cancels, CancelGoal.Request())
    assert answer.return_code == CancelGoal.Response.ERROR_NONE
    assert [bytes(g.goal_id.uuid) for g in answer.goals_canceling] == [bytes(handle.goal_id.uuid)]
    assert executor.result(handle).status == GoalStatus.STATUS_CANCELED
    answer, _ = executor.client.call(cancels, CancelGoal.Request())
    assert answer.return_code == CancelGoal.Response.ERROR_NONE and not answer.goals_canceling
    executor.client.spin_until(lambda: False, 0.3)
    seen = [g.status for array in early for g in array.status_list
            if bytes(g.goal_info.goal_id.uuid) == bytes(handle.goal_id.uuid)]
    order = [s for i, s in enumerate(seen) if i == 0 or seen[i - 1] != s]
    assert order == [GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING,
                     GoalStatus.STATUS_CANCELED]
    late = []
    executor.client.node.create_subscription(
        GoalStatusArray, f"{name}/_action/status", late.append, LATCHED)
    assert executor.client.spin_until(lambda: late, 5.0) is not None
    executor.client.spin_until(lambda: False, 0.3)
    assert late[-1].status_list[-1].status == GoalStatus.STATUS_CANCELED
