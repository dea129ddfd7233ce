"""What the graph says of the node: types with their hashes, descriptions, loggers, endpoints that do not match."""

import json
import sys
from pathlib import Path

import pytest
from conftest import start_node, wait_until
from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tcvae_msgs.srv import SetManner
from trajectory_msgs.msg import JointTrajectory
from type_description_interfaces.srv import GetTypeDescription
from user import User

HERE = Path(__file__).resolve().parent
HASHES = json.loads((HERE.parent / "golden" / "type_hashes.json").read_text())
# Topics on the wire that the node has endpoints of; a service has two.
ENDPOINTS = 70
INTERFACES = HERE.parents[1] / "msg" / "tcvae_msgs"


def ros_name(dds_type):
    """package/kind/Type of package::kind::dds_::Type_."""
    return dds_type.replace("::dds_::", "::").replace("::", "/").removesuffix("_")


def endpoints(client, node_name="tcvae"):
    """All endpoints of the node, by their topics on the wire."""
    found = {}
    node = client.node
    names = {name for name, _ in node.get_topic_names_and_types(no_demangle=True)}
    for name in names:
        infos = [*node.get_publishers_info_by_topic(name, no_mangle=True),
                 *node.get_subscriptions_info_by_topic(name, no_mangle=True)]
        infos = [info for info in infos if info.node_name == node_name]
        if infos:
            found[name] = infos
    return found


def test_every_endpoint_has_the_type_hash_of_rclpy(node, user):
    found = {}
    assert user.until(lambda: found.update(endpoints(user.client)) or len(found) >= ENDPOINTS, 10.0), sorted(found)
    for topic, infos in found.items():
        for info in infos:
            kind = ros_name(info.topic_type)
            if topic == "ros_discovery_info":
                continue
            assert str(info.topic_type_hash) == HASHES[kind], (topic, kind)


def test_actions_and_services_are_listed_with_their_types(node, user):
    services = dict(user.client.node.get_service_names_and_types_by_node("tcvae", "/"))
    assert services["/tcvae/execute/_action/send_goal"] == ["tcvae_msgs/action/Execute_SendGoal"]
    assert services["/tcvae/execute/_action/cancel_goal"] == ["action_msgs/srv/CancelGoal"]
    assert services["/tcvae/get_type_description"] == ["type_description_interfaces/srv/GetTypeDescription"]
    clients = dict(user.client.node.get_client_names_and_types_by_node("tcvae", "/"))
    assert clients["/joint_trajectory_controller/follow_joint_trajectory/_action/send_goal"] == [
        "control_msgs/action/FollowJointTrajectory_SendGoal"]


@pytest.mark.parametrize("name", ["std_msgs/msg/String", "tcvae_msgs/msg/Sample", "tcvae_msgs/srv/SetManner",
                                  "trajectory_msgs/msg/JointTrajectory"])
def test_types_are_described_as_by_rosidl(node, user, name):
    package, kind, last = name.split("/")
    answer = user.call(GetTypeDescription, "get_type_description", type_name=name, type_hash=HASHES[name],
                       include_type_sources=True)
    assert answer.successful, answer.failure_reason
    path = Path(sys.prefix) / "share" / package / kind / f"{last}.json"
    expected = json.loads(path.read_text())["type_description_msg"]

    def plain(of):
        return {"type_name": of.type_name, "fields": [
            {"name": f.name, "type": {n: getattr(f.type, n) for n in (
                "type_id", "capacity", "string_capacity", "nested_type_name")}} for f in of.fields]}

    def without_defaults(of):
        return {"type_name": of["type_name"],
                "fields": [{"name": f["name"], "type": f["type"]} for f in of["fields"]]}

    described = answer.type_description
    assert plain(described.type_description) == without_defaults(expected["type_description"])
    assert [plain(d) for d in described.referenced_type_descriptions] == [
        without_defaults(d) for d in expected["referenced_type_descriptions"]]
    if package == "tcvae_msgs":
        sources = {s.type_name: s.raw_file_contents for s in answer.type_sources}
        assert sources[name] == (INTERFACES / kind / f"{last}.{kind}").read_text()


def test_a_type_of_another_hash_or_none_of_the_nodes_is_refused(node, user):
    answer = user.call(GetTypeDescription, "get_type_description", type_name="std_msgs/msg/String",
                       type_hash="RIHS01_" + 64 * "0")
    assert not answer.successful and HASHES["std_msgs/msg/String"] in answer.failure_reason
    answer = user.call(GetTypeDescription, "get_type_description", type_name="std_msgs/msg/Bool")
    assert not answer.successful and "std_msgs/msg/Bool" in answer.failure_reason


def test_levels_of_loggers_are_set_while_the_node_runs(node, user):
    def level(name="tcvae"):
        return user.call(GetLoggerLevels, "get_logger_levels", names=[name]).levels[0].level

    def set_level(number, name="tcvae"):
        levels = [LoggerLevel(name=name, level=number)]
        return user.call(SetLoggerLevels, "set_logger_levels", levels=levels).results[0]

    assert level() == 20 and level("rustdds") == 0
    user.publish_location("source_cup", 0.6, 0.1)
    assert not user.said("source_cup is (0.600, 0.100)")
    assert set_level(10).successful and level() == 10
    user.publish_location("source_cup", 0.6, 0.12)
    user.hears("source_cup is (0.600, 0.120)")
    assert {m.level for m in user.log if "source_cup is" in m.msg} == {10}
    assert set_level(40).successful and level() == 40
    before = len(user.log)
    user.call(SetManner, "set_manner", names=["no_such"], values=[1.0])
    user.wait(0.3)
    assert len(user.log) == before
    refused = set_level(17)
    assert not refused.successful and "there is no level 17" in refused.reason
    assert set_level(0).successful and level() == 20


def test_endpoints_that_do_not_match_are_told_of_once_with_the_fix(node, user):
    make = user.client.node
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    make.create_publisher(PointStamped, "/tcvae/source_cup", best_effort)
    user.hears("a publisher of /tcvae/source_cup does not match in reliability "
               "(best effort is offered, reliable requested)")
    assert user.said("publish with reliable reliability")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    make.create_subscription(JointTrajectory, "/tcvae/joint_trajectory", lambda _: None, latched)
    user.hears("a subscription of /tcvae/joint_trajectory does not match in durability")
    assert user.said("--qos-durability volatile")
    user.wait(4.0)
    assert sum("source_cup does not match" in m.msg for m in user.log) == 1


def test_two_nodes_tell_the_same_hash_so_that_they_match(start, make_client):
    """The user data travel with the endpoints of both, and do not keep them apart."""
    start_node(start)
    start_node(start, "--ros-args", "-r", "__node:=other")
    client = make_client()
    for name in ("tcvae", "other"):
        answer, _ = client.call(client.service(Trigger, f"/{name}/sample"), Trigger.Request())
        assert not answer.success and "NO_TASK" in answer.message
    strings = []
    client.node.create_subscription(
        String, "/other/model_info", strings.append,
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    assert client.spin_until(lambda: strings, 5.0) is not None


def test_everything_is_gone_when_the_node_is(start, make_client):
    process = start_node(start)
    client = make_client()
    assert client.spin_until(lambda: len(endpoints(client)) >= ENDPOINTS, 10.0) is not None
    assert process.interrupt() == 0
    assert wait_until(lambda: not endpoints(client), 2.0) is not None, sorted(endpoints(client))
